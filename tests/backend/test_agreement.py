"""Hold every backend, in float32, against the reference in float64: maps, ids, gradients as vectors."""

from typing import Any

import numpy as np
import pytest
import torch

from sigmasplat.render import reference
from splat_oracle import look
from splat_scenes import KINDS, Scene, assert_same_vector, gradients, probe, render, scene, twist_gradient

COUNT = 60
BLEND_INPUTS = ("means2d", "conics", "z", "opacities", "features")


def assert_same_map(got: torch.Tensor, want: torch.Tensor, what: str) -> None:
    """Hold two maps together: 99.9 % of the entries and the whole, relative to the map's own size."""
    assert got.shape == want.shape and got.dtype == torch.float32, what
    error, size = (got.detach().double() - want).abs(), float(want.abs().max())
    assert float(torch.quantile(error.flatten(), 0.999)) < 2e-5 * size, (
        f"{what}: {float(error.max()):.2e} of {size:.2e}"
    )
    assert float(error.norm()) < 2e-5 * float(want.norm()), f"{what}: norm-wise"


@pytest.mark.parametrize("kind", KINDS)
def test_project_agrees(backend: Any, kind: str) -> None:
    s = scene(kind, COUNT)
    f = s.to(torch.float32).requiring_grad()
    want = reference.project(s.means, s.quats, s.scales, s.T_camera_world, s.camera, s.options)
    got = backend.project(f.means, f.quats, f.scales, f.T_camera_world, f.camera, f.options)
    seen = want.radii[:, 0] > 0
    assert torch.equal(got.radii[:, 0] > 0, seen) and seen.any() and not got.radii.requires_grad
    for name in ("means2d", "conics", "z", "radii"):
        assert_same_map(getattr(got, name)[seen], getattr(want, name)[seen], f"{kind} {name}")
        assert torch.isfinite(getattr(got, name)).all()


@pytest.mark.parametrize("kind", KINDS)
def test_maps_agree(backend: Any, kind: str) -> None:
    s = scene(kind, COUNT)
    want, got = render(reference, s)[1], render(backend, s.to(torch.float32))[1]
    for name in ("sums", "moment", "alpha", "median_weight", "dominant_weight"):
        assert_same_map(getattr(got, name), getattr(want, name), f"{kind} {name}")


@pytest.mark.parametrize("kind", KINDS)
def test_ids_name_the_right_splats(backend: Any, kind: str) -> None:
    s = scene(kind, COUNT)
    picture, got = look(s), render(backend, s.to(torch.float32).requiring_grad())[1]
    assert got.sums.requires_grad and got.moment.requires_grad and got.alpha.requires_grad
    for ids, weights in ((got.median_id, got.median_weight), (got.dominant_id, got.dominant_weight)):
        assert ids.dtype == torch.int32 and not weights.requires_grad
        named = np.take_along_axis(picture.weights, ids.clamp(min=0).long().numpy()[None], 0)[0]
        np.testing.assert_allclose(weights, np.where(ids >= 0, named, 0.0), atol=2e-5)
    np.testing.assert_array_equal(got.median_id, picture.median_id)
    largest = picture.weights.max(0)
    np.testing.assert_array_equal(got.dominant_id.numpy() >= 0, largest > 0)
    np.testing.assert_allclose(got.dominant_weight, largest, atol=2e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_agree(backend: Any, kind: str) -> None:
    s = scene(kind, COUNT)
    want, got = gradients(reference, s), gradients(backend, s.to(torch.float32))
    for name in want:
        assert_same_vector(got[name], want[name], what=f"{kind} {name}")


@pytest.mark.parametrize("kind", ["random", "needles", "off_screen"])
def test_gradients_without_the_covariance_path_agree(backend: Any, kind: str) -> None:
    s = scene(kind, COUNT).with_options(covariance_pose_gradient=False)
    want, got = gradients(reference, s), gradients(backend, s.to(torch.float32))
    assert_same_vector(got["pose"], want["pose"], what=f"{kind} pose")
    assert_same_vector(got["means"], want["means"], what=f"{kind} means")


def blend_gradients(backend: Any, s: Scene, inputs: dict[str, torch.Tensor], radii: torch.Tensor) -> Any:
    """Differentiate blend alone, with a wanted gradient for each of its inputs."""
    dtype = s.means.dtype
    leaves = {k: v.detach().to(dtype).clone().requires_grad_() for k, v in inputs.items()}
    means2d, conics, z, opacities, features = leaves.values()
    b = backend.blend(means2d, conics, z, radii.to(dtype), opacities, features, s.ref_depth, s.camera, s.options)
    probe(b.sums, b.moment, b.alpha).backward()
    return {k: v.grad for k, v in leaves.items()}


@pytest.mark.parametrize("channels", [1, 3, 7, 11])
def test_blend_alone_agrees_for_any_number_of_channels(backend: Any, channels: int) -> None:
    s = scene("random", COUNT, channels=channels)
    p = reference.project(s.means, s.quats, s.scales, s.T_camera_world, s.camera, s.options)
    given = dict(zip(BLEND_INPUTS, (p.means2d, p.conics, p.z, s.opacities, s.features), strict=True))
    exact = {k: v.float().double() for k, v in given.items()}
    want = blend_gradients(reference, s, exact, p.radii)
    got = blend_gradients(backend, s.to(torch.float32), exact, p.radii)
    for name in BLEND_INPUTS:
        assert_same_vector(got[name], want[name], what=f"{channels} channels, {name}")


@pytest.mark.parametrize("kind", ["random", "needles", "near_plane"])
def test_project_alone_agrees_for_each_output(backend: Any, kind: str) -> None:
    s = scene(kind, COUNT)
    for k, name in enumerate(("means2d", "conics", "z")):
        grads = []
        for engine, dtype in ((reference, torch.float64), (backend, torch.float32)):
            x = s.to(dtype).requiring_grad()
            probe(engine.project(x.means, x.quats, x.scales, x.T_camera_world, x.camera, x.options)[k]).backward()
            grads.append(x)
        want, got = grads
        twists = [twist_gradient(x.T_camera_world.grad, s.T_camera_world) for x in (got, want)]
        assert_same_vector(*twists, what=f"{kind} ∂{name}/∂ξ")
        for leaf in ("means", "quats", "scales") if name == "conics" else ("means",):
            assert_same_vector(getattr(got, leaf).grad, getattr(want, leaf).grad, what=f"{kind} ∂{name}/∂{leaf}")


def test_moment_is_optional(backend: Any) -> None:
    s = scene("random", COUNT).to(torch.float32)
    p, with_ref = render(backend, s)
    without = backend.blend(*p, s.opacities, s.features, None, s.camera, s.options)
    assert without.moment is None
    assert torch.equal(without.sums, with_ref.sums) and torch.equal(without.alpha, with_ref.alpha)


def test_two_runs_give_identical_bytes(backend: Any) -> None:
    s = scene("random", COUNT).to(torch.float32)
    first, second = gradients(backend, s), gradients(backend, s)
    for name in first:
        assert torch.equal(first[name], second[name]), name
    for a, b in zip(render(backend, s)[1], render(backend, s)[1], strict=True):
        assert torch.equal(a, b)
