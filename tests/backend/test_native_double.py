"""Hold splat.h itself, compiled in double, against differences of its own projection and against the reference."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from native_double import project_double
from sigmasplat.data import se3
from sigmasplat.render import reference
from sigmasplat.render.kernels import view_params
from splat_oracle import depths
from splat_scenes import KINDS, Scene, scene, twist_gradient

Array = NDArray[np.float64]
PARTS = {"mean": slice(0, 3), "quat": slice(3, 7), "scale": slice(7, 10), "rho": slice(10, 13), "phi": slice(13, 16)}
STEP = 2e-5
STENCIL = ((1, 8 / 12), (-1, -8 / 12), (2, -1 / 12), (-2, 1 / 12))
"""Central differences of fourth order: (offset in steps, weight)."""


def in_front(s: Scene) -> Scene:
    """Keep the splats before the near plane: behind it the header's arithmetic is only finite, not meant."""
    front = torch.as_tensor(depths(s) > 1.05 * s.options.near_m)
    return Scene(**(vars(s) | {name: getattr(s, name)[front] for name in ("means", "quats", "scales", "opacities")}))


def native(s: Scene, T: Array, shape: Array, g: Array) -> tuple[Array, Array]:
    """Project rows of (mean, quat, scale) [N, 10]; return footprints (u, v, z, conic, slopes) and gradients [N, 16]."""
    mean, quat, scale = (shape[:, PARTS[name]] for name in ("mean", "quat", "scale"))
    return project_double(view_params(s.camera, T, s.options, np.float64), mean, quat, scale, g)


def rows(s: Scene) -> Array:
    return np.concatenate([s.means.numpy(), s.quats.numpy(), s.scales.numpy()], 1)


def differences(s: Scene, g: Array) -> Array:
    """Differentiate g · footprint by each of the 16 numbers, one column at a time, all splats at once."""
    T, shape, out = s.T_camera_world.numpy(), rows(s), np.zeros((len(s.means), 16))
    z = depths(s)
    for k in range(16):
        step = STEP * (shape[:, k] if 7 <= k < 10 else z if k < 3 else np.ones(len(z)))
        for offset, weight in STENCIL:
            if k < 10:
                moved = shape.copy()
                moved[:, k] += offset * step
                footprint = native(s, T, moved, g)[0]
            else:
                footprint = native(s, se3.exp(offset * STEP * np.eye(6)[k - 10]) @ T, shape, g)[0]
            # Each number of the footprint is differenced alone: what a parameter does not touch cancels exactly.
            out[:, k] += ((footprint - native(s, T, shape, g)[0]) * g).sum(1) * weight / step
    return out


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_equal_finite_differences(kind: str) -> None:
    s = in_front(scene(kind, 60))
    g = np.random.default_rng(1).normal(size=(len(s.means), 8))
    got, want = native(s, s.T_camera_world.numpy(), rows(s), g)[1], differences(s, g)
    for name, columns in PARTS.items():
        error = np.linalg.norm(got[:, columns] - want[:, columns], axis=1)
        size = np.linalg.norm(want[:, columns], axis=1)
        assert size.min() > 0
        assert (error / size).max() < 1e-7, f"{kind} {name}: {(error / size).max():.1e}"


@pytest.mark.parametrize("covariance_path", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_projection_and_gradients_equal_the_reference(kind: str, covariance_path: bool) -> None:
    s = in_front(scene(kind, 60)).with_options(covariance_pose_gradient=covariance_path)
    g = np.random.default_rng(2).normal(size=(len(s.means), 8))
    footprint, gradient = native(s, s.T_camera_world.numpy(), rows(s), g)

    x = s.requiring_grad()
    p = reference.project(x.means, x.quats, x.scales, x.T_camera_world, x.camera, x.options)
    slopes = reference.depth_slopes(x.means, x.quats, x.scales, x.T_camera_world, x.camera, x.options)
    maps = torch.cat([p.means2d, p.z[:, None], p.conics, slopes], 1)
    np.testing.assert_allclose(footprint, maps.detach().numpy(), rtol=1e-9, atol=1e-11)
    (maps * torch.as_tensor(g)).sum().backward()
    for name, leaf in (("mean", x.means), ("quat", x.quats), ("scale", x.scales)):
        assert leaf.grad is not None
        want, got = leaf.grad.numpy(), gradient[:, PARTS[name]]
        assert np.abs(got - want).max() < 1e-9 * np.abs(want).max(), name
    assert x.T_camera_world.grad is not None
    want = twist_gradient(x.T_camera_world.grad, s.T_camera_world).numpy()
    assert np.abs(gradient[:, 10:].sum(0) - want).max() < 1e-9 * np.abs(gradient[:, 10:]).sum(0).max()


def test_the_norm_of_a_quaternion_means_nothing() -> None:
    s = in_front(scene("needles", 30))
    T, g = s.T_camera_world.numpy(), np.ones((len(s.means), 8))
    longer = rows(s)
    longer[:, PARTS["quat"]] *= 7.0
    (a, ga), (b, gb) = native(s, T, rows(s), g), native(s, T, longer, g)
    np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(gb[:, PARTS["quat"]] * 7.0, ga[:, PARTS["quat"]], rtol=1e-8, atol=1e-10)
    radial = (ga[:, PARTS["quat"]] * s.quats.numpy()).sum(1)
    np.testing.assert_allclose(radial, 0.0, atol=1e-10 * float(np.abs(ga[:, PARTS["quat"]]).max()))
