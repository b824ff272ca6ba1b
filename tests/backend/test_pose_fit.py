"""fit_pose: its gradient is that of the loss as the paper writes it, and both ways of fitting find a pose."""

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.align import Pyramid, gray_of
from sigmasplat.fit.pose import (
    PoseFit,
    Reference,
    fit_pose_adam,
    fit_pose_align,
    keyframe_reference,
    map_reference,
    tracking_gradient,
)
from sigmasplat.fit.target import Target
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import COLUMNS, GaussianField
from sigmasplat.model.frame import Frame
from sigmasplat.render.view import View, make_view
from sigmasplat.sources import SyntheticRoom
from splat_fields import OPTIONS
from splat_scenes import assert_same_vector, twist_gradient

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

Array = NDArray[np.float64]
CAMERA = Camera(40, 30, 34.0, 35.0, 18.9, 15.2)
TRUTH = se3.exp(np.array([0.1, -0.05, 0.1, 0.05, 0.1, -0.08]))
"""T_camera_world."""
OFF = np.array([0.012, -0.015, 0.01, 0.012, -0.008, 0.015])
STEPS = TrackingConfig(lr_rotation=4e-4, lr_translation=1e-3)
PLAIN = torch.zeros(2)


@cache
def wall(n: int = 400) -> Tensor:
    """Make a wavy, coloured wall about 2 m ahead, as rows [N, 17]; σ² differs from splat to splat."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1.5, 1.5, n), rng.uniform(-1.15, 1.15, n)
    means = np.stack([x, y, 2.0 + 0.25 * np.sin(2.1 * x) + 0.2 * np.cos(3.0 * y)], 1)
    colors = 0.5 + 0.35 * np.stack([np.sin(5 * x), np.cos(4 * y), np.sin(3 * x + 4 * y)], 1)
    values = [torch.as_tensor(a, dtype=torch.float32) for a in (means, np.full(n, 0.12), colors)]
    log_variances = torch.as_tensor(rng.uniform(-9, -2, (n, 3)))
    return GaussianField.from_values(*values, opacities=0.98, log_variances=log_variances).params


@pytest.fixture(params=["reference", "cpu"])
def view(request: pytest.FixtureRequest) -> View:
    return make_view(request.param, CAMERA, OPTIONS)


def seen_from(view: View, T_camera_world: Array) -> Target:
    """Show the wall as a camera there would: what a fit has to find again, exact but for rounding."""
    view.forward(wall(), T_camera_world)
    h, w = CAMERA.height, CAMERA.width
    color = view.sums[:3, :h, :w].movedim(0, -1).numpy().copy()
    depth = torch.where(view.alpha[:h, :w] > 0.5, view.sums[3, :h, :w], 0.0).numpy().copy()
    return Target.of(Frame(0, 0.0, color, depth, CAMERA), (view.alpha.shape[0], view.alpha.shape[1]))


def assert_near(found: Array, true: Array, metres: float, degrees: float) -> None:
    off = se3.inverse(true) @ found
    assert np.linalg.norm(off[:3, 3]) < metres, f"{1e3 * np.linalg.norm(off[:3, 3]):.2f} mm"
    assert np.rad2deg(se3.rotation_angle(off[:3, :3])) < degrees, f"{np.rad2deg(se3.rotation_angle(off[:3, :3])):.3f}°"


# ---- the gradient


def damaged(view: View) -> Target:
    """Draw a target with another colour, holes, noise and gross errors in depth."""
    rng, clean = np.random.default_rng(3), seen_from(view, TRUTH)
    depth = clean.depth_image.numpy() + rng.normal(0, 0.01, (CAMERA.height, CAMERA.width))
    depth[rng.random(depth.shape) < 0.2] = 0.0
    depth[5:9, 5:20] += 2.0
    color = rng.random((CAMERA.height, CAMERA.width, 3)).astype(np.float32)
    frame = Frame(0, 0.0, color, np.maximum(depth, 0).astype(np.float32), CAMERA)
    return Target.of(frame, (view.alpha.shape[0], view.alpha.shape[1]))


def lower_median(values: Tensor) -> Tensor:
    return values.sort().values[(len(values) - 1) // 2]


def paper_loss(sums: Tensor, alpha: Tensor, target: Target, c: TrackingConfig, exposure: Tensor) -> Tensor:
    """Write VarSplat §3 out: sums [7, H, W], alpha [H, W], float64; A³, M and w̃ carry no gradient."""
    color, depth, read = sums[:3], sums[3], target.depth_image.double()
    valid = (read > 0) & (alpha > c.alpha_above) if c.alpha_above else read > 0
    error = (depth - read).abs().detach()
    mask = valid & (error <= c.outlier_factor * lower_median(error[valid])) if c.outlier_factor else valid
    weights = torch.ones_like(color)
    if c.uncertainty:
        log = ((sums[4:] - color**2).detach().clamp(min=0) + 1e-6).log()
        for channel in range(3):
            ratio = torch.exp(-(log[channel] - lower_median(log[channel][mask])) / c.tau)
            weights[channel] = ratio.clamp(1 / c.weight_max, c.weight_max)
    image = target.image.double().movedim(-1, 0)
    photometric = (weights * (exposure[0].exp() * color + exposure[1] - image).abs()).sum(0)
    geometric = (depth - read).abs()
    per_pixel = c.weight_color * photometric + (1 - c.weight_color) * geometric
    return (alpha.detach() ** c.alpha_power * mask * per_pixel).sum() / alpha.numel()


SETTINGS: dict[str, dict[str, Any]] = {
    "ours": {"tau": 2.0},
    "masked": {"tau": 2.0, "alpha_above": 0.9, "outlier_factor": 5.0},
    "replica": {"tau": 10.0, "weight_color": 0.95, "outlier_factor": 0.0},
    "no uncertainty": {"uncertainty": False},
}


@pytest.mark.parametrize("name", SETTINGS)
def test_planes_hold_the_gradient_of_the_papers_loss(view: View, name: str) -> None:
    config, exposure = TrackingConfig(**SETTINGS[name]), torch.tensor([0.12, -0.03])
    target, h, w = damaged(view), CAMERA.height, CAMERA.width
    view.forward(wall(), se3.exp(OFF) @ TRUTH)
    view.g_sums.fill_(torch.nan)  # whatever was there must go
    loss, g_exposure = tracking_gradient(view, target, config, exposure)
    leaves = view.sums[:, :h, :w].double().requires_grad_(), exposure.double().requires_grad_()
    alpha = view.alpha[:h, :w].double().requires_grad_()
    want = paper_loss(leaves[0], alpha, target, config, leaves[1])
    g_sums, want_exposure = torch.autograd.grad(want, leaves)
    assert loss == pytest.approx(float(want.detach()), rel=1e-5)
    assert_same_vector(view.g_sums[:4, :h, :w], g_sums[:4], 1e-5, "planes")
    assert_same_vector(g_exposure, want_exposure, 1e-5, "exposure")


def test_weights_and_alpha_are_held_still(view: View) -> None:
    """The pose may not lower the loss by looking where V is large or the map is thin: no path leads there."""
    target, h, w = damaged(view), CAMERA.height, CAMERA.width
    view.forward(wall(), se3.exp(OFF) @ TRUTH)
    tracking_gradient(view, target, TrackingConfig(tau=1.0), PLAIN)
    assert torch.count_nonzero(view.g_sums[4:]) == 0 and torch.count_nonzero(view.g_alpha) == 0
    outside = view.g_sums.clone()
    outside[:, :h, :w] = 0.0
    assert torch.count_nonzero(outside) == 0, "padding must feel nothing"


def test_no_gradient_where_there_is_no_reading(view: View) -> None:
    target, h, w = damaged(view), CAMERA.height, CAMERA.width
    view.forward(wall(), TRUTH)
    tracking_gradient(view, target, TrackingConfig(outlier_factor=0.0), PLAIN)
    unread = target.depth_image == 0
    assert unread.sum() > 100 and torch.count_nonzero(view.g_sums[:, :h, :w][:, unread]) == 0
    assert torch.count_nonzero(view.g_sums[:, :h, :w][:, ~unread]) > 1000


def test_the_twist_is_the_loss_differentiated_by_the_pose_through_the_renderer(view: View) -> None:
    """Frozen weights, everything else through `render` and autograd: the sign and frame of the pose step."""
    from sigmasplat.render import render

    target, config, h, w = damaged(view), TrackingConfig(tau=2.0), CAMERA.height, CAMERA.width
    T_start = se3.exp(OFF) @ TRUTH
    view.forward(wall(), T_start)
    tracking_gradient(view, target, config, PLAIN)
    twist = view.backward(wall(), None)
    T = torch.as_tensor(T_start).requires_grad_()
    with torch.no_grad():
        frozen = view.sums[:, :h, :w].double()
    maps = render(GaussianField(wall().double()), CAMERA, T, options=OPTIONS, backend="reference")
    moving = torch.cat([maps.color.movedim(-1, 0), maps.depth[None], frozen[4:]]).double()
    # V is read off the frozen planes: put E[σ² + c²] where (sums[4:] − colour²) gives the frozen V again.
    moving[4:] = (frozen[4:] - frozen[:3] ** 2) + moving[:3].detach() ** 2
    loss = paper_loss(moving, view.alpha[:h, :w].double(), target, config, PLAIN.double())
    (matrix,) = torch.autograd.grad(loss, (T,))
    assert_same_vector(torch.as_tensor(twist), twist_gradient(matrix, torch.as_tensor(T_start)), 1e-3, "twist")


# ---- descent


def descended(view: View, config: TrackingConfig, iterations: int = 80, start: Array = OFF) -> PoseFit:
    return fit_pose_adam(wall(), view, seen_from(view, TRUTH), se3.exp(start) @ TRUTH, config, iterations)


def test_descent_finds_a_pose_again(view: View) -> None:
    fit = descended(view, dataclasses.replace(STEPS, tau=5.0))
    assert_near(fit.T_camera_world, TRUTH, 2e-3, 0.1)
    assert fit.loss < 0.2 * fit.first_loss and fit.iterations == 80
    assert fit.agreement > 0.95 and fit.overlap > 0.95
    assert se3.is_rigid(fit.T_camera_world, 1e-9)


def test_the_best_iterate_wins(view: View) -> None:
    """Steps of half a metre lead nowhere: the first guess comes back, and its loss."""
    fit = descended(view, dataclasses.replace(STEPS, lr_translation=0.5), iterations=4)
    assert_near(fit.T_camera_world, se3.exp(OFF) @ TRUTH, 1e-9, 1e-5)
    assert fit.loss == fit.first_loss


def test_without_a_reading_the_guess_comes_back(view: View) -> None:
    blind = seen_from(view, TRUTH)
    blind.depth.zero_()
    blind = dataclasses.replace(blind, valid_pixels=0)
    fit = fit_pose_adam(wall(), view, blind, TRUTH, STEPS, 3)
    assert_near(fit.T_camera_world, TRUTH, 1e-9, 1e-5)
    assert fit.agreement == fit.overlap == 0.0


def test_exposure_is_found_where_asked() -> None:
    view = make_view("cpu", CAMERA, OPTIONS)
    target = seen_from(view, TRUTH)
    target.color.mul_(np.exp(0.1)).add_(0.03)
    config = dataclasses.replace(STEPS, exposure=True, lr_exposure=4e-3)
    fit = fit_pose_adam(wall(), view, target, se3.exp(0.3 * OFF) @ TRUTH, config, 90)
    np.testing.assert_allclose(fit.exposure, (0.1, 0.03), atol=0.015)
    assert_near(fit.T_camera_world, TRUTH, 2e-3, 0.1)
    assert fit_pose_adam(wall(), view, target, TRUTH, STEPS, 5).exposure == (0.0, 0.0)


def test_descent_that_stands_still_stops(view: View) -> None:
    crawling = dataclasses.replace(STEPS, lr_rotation=1e-9, lr_translation=1e-9, update_stop=1e-6)
    assert descended(view, crawling, iterations=9).iterations == 2
    assert descended(view, dataclasses.replace(crawling, update_stop=0.0), iterations=9).iterations == 9


# ---- references to align to


def pyramid(target: Target) -> Pyramid:
    return Pyramid.of(gray_of(target.image.numpy()), target.depth_image.numpy(), CAMERA)


def half_unsure() -> Tensor:
    """Make the right half of the wall's colours uncertain."""
    params = wall().clone()
    params[:, COLUMNS["log_variances"]] = torch.where(params[:, :1] > 0.1, -2.0, -8.0)
    return params


def test_a_keyframes_pixels_count_less_where_the_map_is_unsure(view: View) -> None:
    image = pyramid(seen_from(view, TRUTH))
    config = TrackingConfig(tau=2.0, weight_max=3.0)
    reference = keyframe_reference(half_unsure(), view, image, TRUTH, config)
    weight = reference.pyramid.weight[0]
    assert weight is not None and weight.shape == (CAMERA.height, CAMERA.width)
    opaque = view.alpha[: CAMERA.height, : CAMERA.width].numpy() > 0.95
    u = np.arange(CAMERA.width)[None].repeat(CAMERA.height, 0)
    sure, unsure = weight[opaque & (u < 12)], weight[opaque & (u > 28)]
    assert len(sure) > 100 and len(unsure) > 100
    assert np.median(unsure) < 0.5 * np.median(sure) and weight.min() >= 1 / 3 and weight.max() <= 3.0
    np.testing.assert_array_equal(weight[~opaque], 1.0)  # where the map is thin, V says nothing
    np.testing.assert_array_equal(reference.pyramid.gray[0], image.gray[0])
    np.testing.assert_array_equal(reference.pyramid.depth[0], image.depth[0])
    np.testing.assert_array_equal(reference.T_camera_world, TRUTH)


@pytest.mark.parametrize("kind", ["keyframe", "map"])
def test_a_reference_weighs_pixels_by_the_papers_weights(view: View, kind: str) -> None:
    image, config = pyramid(seen_from(view, TRUTH)), TrackingConfig(tau=3.0, weight_max=2.0)
    if kind == "keyframe":
        reference = keyframe_reference(wall(), view, image, TRUTH, config)
    else:
        reference = map_reference(wall(), view, TRUTH, config)
    h, w = CAMERA.height, CAMERA.width
    sums, opaque = view.sums[:, :h, :w].double(), view.alpha[:h, :w] > 0.95
    log = ((sums[4:] - sums[:3] ** 2).clamp(min=0) + 1e-6).log()
    medians = torch.stack([lower_median(channel[opaque]) for channel in log])
    expected = torch.exp((medians[:, None, None] - log) / 3.0).clamp(0.5, 2.0).mean(0)
    np.testing.assert_allclose(reference.pyramid.weight[0], torch.where(opaque, expected, 1.0), rtol=1e-3)


def test_without_uncertainty_a_keyframe_is_its_image_alone(view: View) -> None:
    image = pyramid(seen_from(view, TRUTH))
    config = TrackingConfig(uncertainty=False)
    assert keyframe_reference(wall(), view, image, TRUTH, config).pyramid is image
    assert map_reference(wall(), view, TRUTH, config).pyramid.weight[0] is None


def test_the_map_as_reference_is_surface_and_colour_undimmed(view: View) -> None:
    reference = map_reference(wall(), view, TRUTH, TrackingConfig())
    h, w = CAMERA.height, CAMERA.width
    sums, alpha = view.sums[:, :h, :w].numpy(), view.alpha[:h, :w].numpy()
    opaque = alpha > 0.95
    assert 100 < opaque.sum() < opaque.size
    np.testing.assert_allclose(reference.pyramid.depth[0], np.where(opaque, sums[3] / alpha, 0.0), rtol=1e-5)
    gray = 0.299 * sums[0] + 0.587 * sums[1] + 0.114 * sums[2]
    np.testing.assert_allclose(reference.pyramid.gray[0][opaque], (gray / alpha)[opaque], rtol=1e-5)


def test_aligning_gives_the_live_cameras_pose_in_the_references_world() -> None:
    room = SyntheticRoom(frames=200, width=160, height=120, exposure_change=False)
    T_camera_world = [se3.inverse(T) for T in room.truth().T_world_camera]
    images = [Pyramid.of(gray_of(f.color), f.depth_m, f.camera) for f in map(room.frame, (10, 12))]
    reference, config = Reference(images[0], T_camera_world[10]), TrackingConfig(align_iterations=20)
    for guess in (10, 11):
        fit = fit_pose_align(reference, images[1], T_camera_world[guess], config)
        assert_near(fit.T_camera_world, T_camera_world[12], 2e-3, 0.1)
        assert fit.agreement > 0.9 and fit.overlap > 0.7 and fit.covariance is not None
        assert np.isfinite(fit.covariance).all() and np.isnan(fit.first_loss)
