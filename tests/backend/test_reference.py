"""Hold the reference, the definition of the kernels, against finite differences and an oracle, in float64."""

import numpy as np
import pytest
import torch
from torch import Tensor

from sigmasplat.render import reference
from splat_oracle import flat, look
from splat_scenes import (
    FIELD,
    KINDS,
    SMALL,
    Scene,
    assert_same_vector,
    gradients,
    probe,
    render,
    scene,
    twist_differences,
)

STEP = 3e-7


def loss(s: Scene, T_mean: Tensor, T_covariance: Tensor, T_depth: Tensor) -> float:
    """Evaluate the probe with each of the pose's three paths fed by a pose of its own."""
    means2d, conics, z = (
        reference.project(s.means, s.quats, s.scales, T, s.camera, s.options)[k]
        for k, T in enumerate((T_mean, T_covariance, T_depth))
    )
    radii = reference.project(s.means, s.quats, s.scales, s.T_camera_world, s.camera, s.options).radii
    b = reference.blend(means2d, conics, z, radii, s.opacities, s.features, s.ref_depth, s.camera, s.options)
    assert b.moment is not None
    return float(probe(b.sums, b.moment, b.alpha))


def difference_field(s: Scene, name: str) -> Tensor:
    """Differentiate by one field tensor, entry by entry, central differences."""
    tensor, out = getattr(s, name), []
    for k in range(tensor.numel()):
        step = torch.zeros_like(tensor)
        step.view(-1)[k] = STEP
        sides = [render(reference, Scene(**(vars(s) | {name: tensor + sign * step})))[1] for sign in (1, -1)]
        ahead, behind = (float(probe(b.sums, b.moment, b.alpha)) for b in sides)
        out.append((ahead - behind) / (2 * STEP))
    return torch.tensor(out, dtype=torch.float64)


def difference_pose(s: Scene, moves: tuple[bool, bool, bool]) -> Tensor:
    """Differentiate by the twist of exp(ξ)·T, moving only the chosen paths."""
    T_now = s.T_camera_world
    return twist_differences(lambda T: loss(s, *(T if move else T_now for move in moves)), T_now, STEP)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_equal_finite_differences(kind: str) -> None:
    s = scene(kind, 7, SMALL, 1e-3)
    found = gradients(reference, s)
    for name in FIELD:
        assert_same_vector(found[name], difference_field(s, name), 1e-6, f"{kind} {name}")
    assert_same_vector(found["pose"], difference_pose(s, (True, True, True)), 1e-6, f"{kind} pose")


@pytest.mark.parametrize("kind", ["random", "off_screen"])
def test_the_covariance_path_alone_equals_finite_differences(kind: str) -> None:
    s = scene(kind, 7, SMALL, 1e-3)
    frozen = gradients(reference, s.with_options(covariance_pose_gradient=False))["pose"]
    assert_same_vector(frozen, difference_pose(s, (True, False, True)), 1e-6, "without the covariance")
    alone = gradients(reference, s)["pose"] - frozen
    assert_same_vector(alone, difference_pose(s, (False, True, False)), 1e-6, "the covariance alone")


def test_the_pose_switch_leaves_field_gradients_complete() -> None:
    s = scene("random", 7, SMALL, 1e-3)
    off = gradients(reference, s.with_options(covariance_pose_gradient=False))
    for name, gradient in gradients(reference, s).items():
        assert name == "pose" or torch.equal(gradient, off[name])


@pytest.mark.parametrize("kind", KINDS)
def test_maps_equal_the_oracle(kind: str) -> None:
    s = scene(kind, 40)
    picture, (_, b) = look(s), render(reference, s)
    np.testing.assert_allclose(b.sums, picture.sums, atol=1e-12)
    np.testing.assert_allclose(b.moment, picture.moment, atol=1e-11)
    np.testing.assert_allclose(b.alpha, picture.alpha, atol=1e-12)
    np.testing.assert_array_equal(b.median_id, picture.median_id)
    np.testing.assert_allclose(b.dominant_weight, picture.weights.max(0), atol=1e-12)


def test_conics_are_the_upper_cholesky_factor_of_the_inverse_covariance() -> None:
    s = scene("needles", 40)
    p = reference.project(s.means, s.quats, s.scales, s.T_camera_world, s.camera, s.options)
    for i in range(len(s.means)):
        l1, l2, l3 = p.conics[i].tolist()
        mean, covariance, z = flat(s, i)
        U = np.array([[l1, l2], [0.0, l3]])
        np.testing.assert_allclose(U.T @ U @ covariance, np.eye(2), atol=1e-8)
        np.testing.assert_allclose(p.means2d[i], mean, atol=1e-10)
        np.testing.assert_allclose(p.radii[i], np.sqrt(np.diag(covariance)), rtol=1e-12)
        assert float(p.z[i]) == pytest.approx(z)


def test_chunks_of_pixels_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    s = scene("random", 40)
    whole = render(reference, s)[1]
    monkeypatch.setattr(reference, "PAIRS_AT_ONCE", 41 * 100)
    for a, b in zip(whole, render(reference, s)[1], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-14)
