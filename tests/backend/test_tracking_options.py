"""Descent as CG-SLAM does it (§6): colour's own mask, averages over what is kept, axis-angle, a second frame apart."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from constants import changed
from paper_settings import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.pose import PoseFit, fit_pose_adam
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import Target, gray_of
from sigmasplat.render.backend import make_view
from sigmasplat.render.view import View
from sigmasplat.tracking import tracker
from sigmasplat.tracking.prepared_frame import PreparedFrame
from splat_fields import OPTIONS
from splat_scenes import assert_same_vector
from splat_wall import CAMERA, TRUTH, Array, assert_near, lower_median, seen_from, wall

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

H, W = CAMERA.height, CAMERA.width
OFF = np.array([0.012, -0.015, 0.01, 0.012, -0.008, 0.015])
FAR_OFF = np.array([0.03, -0.02, 0.025, 0.02, -0.03, 0.02])
"""4 cm and 2.4°."""
PAPER = TrackingConfig(
    parametrisation="axis-angle", lr_rotation=0.0015, lr_translation=0.00215, weight_color=0.2 / 1.2, uncertainty=False,
    alpha_power=0.0, alpha_above=0.99, outlier_factor=10.0, outlier_factor_color=10.0, average="kept",
)  # fmt: skip
EXPOSURE = torch.tensor([0.12, -0.03])
CHOICES = list(itertools.product(["image", "kept"], [0.0, 2.5], [False, True]))


@pytest.fixture(params=["reference", "cpu"])
def view(request: pytest.FixtureRequest) -> View:
    return make_view(request.param, CAMERA, OPTIONS)


def damaged(view: View) -> Target:
    """Lay out the wall with noise, holes, and gross errors: of depth in one place, of colour in another."""
    rng, clean = np.random.default_rng(3), seen_from(make_view("reference", CAMERA, OPTIONS), TRUTH)
    depth = clean.depth_image.numpy() + rng.normal(0, 0.01, (H, W))
    depth[5:9, 5:20] += 2.0
    depth[rng.random(depth.shape) < 0.2] = 0.0
    color = clean.image.numpy() + rng.normal(0, 0.03, (H, W, 3))
    color[14:18, 10:30] += 0.8
    frame = Frame(0, 0.0, color.astype(np.float32), np.maximum(depth, 0).astype(np.float32), CAMERA)
    return Target.of(frame, (view.alpha.shape[0], view.alpha.shape[1]))


def written_out(sums: Tensor, alpha: Tensor, target: Target, c: TrackingConfig, exposure: Tensor) -> Tensor:
    """Write the loss out in double: sums [7, H, W], alpha [H, W]; masks and weights carry no gradient."""
    read, image = target.depth_image.double(), target.image.double().movedim(-1, 0)
    valid = (read > 0) & (alpha > c.alpha_above)
    geometric = (sums[3] - read).abs()
    photometric = (exposure[0].exp() * sums[:3] + exposure[1] - image).abs()
    total = photometric.sum(0).detach()
    in_depth = valid & (geometric.detach() <= c.outlier_factor * lower_median(geometric.detach()[valid]))
    in_color = in_depth
    if c.outlier_factor_color:
        in_color = valid & (total <= c.outlier_factor_color * lower_median(total[valid]))
    weights = torch.ones_like(photometric)
    if c.uncertainty:
        log = ((sums[4:] - sums[:3] ** 2).detach().clamp(min=0) + 1e-6).log()
        middle = torch.stack([lower_median(channel[in_color]) for channel in log])
        weights = torch.exp((middle[:, None, None] - log) / c.tau).clamp(1 / c.weight_max, c.weight_max)
    color, depth = (
        (weights * alpha**c.alpha_power * photometric)[:, in_color],
        (alpha**c.alpha_power * geometric)[in_depth],
    )
    if c.average == "kept":
        return c.weight_color * color.mean() + (1 - c.weight_color) * depth.mean()
    return (c.weight_color * color.sum() + (1 - c.weight_color) * depth.sum()) / (H * W)


@pytest.mark.parametrize(("average", "factor_color", "uncertainty"), CHOICES)
def test_planes_hold_the_gradient_of_the_loss(view: View, average: Any, factor_color: float, uncertainty: bool) -> None:
    config = TrackingConfig(
        average=average, outlier_factor_color=factor_color, uncertainty=uncertainty, tau=2.0, alpha_above=0.9,
        outlier_factor=5.0, alpha_power=2.0, weight_color=0.3,
    )  # fmt: skip
    target = damaged(view)
    view.forward(wall(), se3.exp(OFF) @ TRUTH)
    view.g_sums.fill_(torch.nan)  # whatever was there must go
    loss, g_exposure = fits_of(view).tracking_loss(view, target, config, EXPOSURE)
    leaves = view.sums[:, :H, :W].double().requires_grad_(), EXPOSURE.double().requires_grad_()
    want = written_out(leaves[0], view.alpha[:H, :W].double(), target, config, leaves[1])
    g_sums, want_exposure = torch.autograd.grad(want, leaves)
    assert loss == pytest.approx(float(want.detach()), rel=1e-5)
    assert_same_vector(view.g_sums[:4, :H, :W], g_sums[:4], 1e-5, "planes")
    assert_same_vector(g_exposure, want_exposure, 1e-5, "exposure")


@pytest.mark.parametrize(("average", "factor_color", "uncertainty"), CHOICES)
def test_the_kernel_does_as_the_definition(isa: str, average: Any, factor_color: float, uncertainty: bool) -> None:
    """On the very same planes, so that no pixel near a limit falls to either side."""
    config = changed(
        PAPER, average=average, outlier_factor_color=factor_color, uncertainty=uncertainty, alpha_power=3.0
    )
    slow, fast = (make_view(backend, CAMERA, OPTIONS) for backend in ("reference", "cpu"))
    slow.forward(wall(), se3.exp(OFF) @ TRUTH)
    fast.sums[:, :H, :W], fast.alpha[:H, :W] = slow.sums, slow.alpha
    found = [fits_of(v).tracking_loss(v, damaged(v), config, EXPOSURE) for v in (slow, fast)]
    (want, want_exposure), (got, got_exposure) = found
    assert got == pytest.approx(want, rel=1e-5) and want > 0
    assert_same_vector(fast.g_sums[:, :H, :W], slow.g_sums, 1e-5, "planes")
    assert_same_vector(got_exposure, want_exposure, 1e-5, "exposure")


def test_colour_and_depth_each_leave_out_their_own_outliers(view: View) -> None:
    """The limit of colour is on the error after exposure, summed over the channels."""
    config = changed(PAPER, outlier_factor=4.0, outlier_factor_color=4.0)
    target = damaged(view)
    gain, offset = EXPOSURE[0].exp(), EXPOSURE[1]
    target.color.mul_(gain).add_(offset)  # so that exposure explains all but noise and the patch
    view.forward(wall(), TRUTH)
    fits_of(view).tracking_loss(view, target, config, EXPOSURE)
    solid = (view.alpha[:H, :W] > 0.99) & (target.depth_image > 0)
    by_color, by_depth = (view.g_sums[:3, :H, :W] != 0).any(0), view.g_sums[3, :H, :W] != 0
    wrong_color, wrong_depth = torch.zeros(H, W, dtype=torch.bool), torch.zeros(H, W, dtype=torch.bool)
    wrong_color[14:18, 10:30], wrong_depth[5:9, 5:20] = True, True
    assert (solid & wrong_color).sum() > 30 and (solid & wrong_depth).sum() > 20
    assert not by_color[wrong_color].any() and by_depth[solid & wrong_color].float().mean() > 0.9
    assert not by_depth[wrong_depth].any() and by_color[solid & wrong_depth].float().mean() > 0.9
    assert not by_color[~solid].any() and not by_depth[~solid].any()


def test_a_mean_over_what_is_kept_does_not_know_how_much_is_left_out(view: View) -> None:
    target, config = seen_from(view, TRUTH), changed(PAPER, outlier_factor=0.0, outlier_factor_color=0.0)
    target.color.add_(0.1)
    target.depth.add_(0.2 * (target.depth > 0))
    view.forward(wall(), TRUTH)
    whole, _ = fits_of(view).tracking_loss(view, target, config, torch.zeros(2))
    assert whole == pytest.approx((0.2 * 0.1 + 0.2) / 1.2, rel=1e-4)
    target.depth[::2] = 0.0
    assert fits_of(view).tracking_loss(view, target, config, torch.zeros(2))[0] == pytest.approx(whole, rel=1e-4)


@pytest.mark.parametrize("average", ["image", "kept"])
@pytest.mark.parametrize("uncertainty", [False, True])
def test_nothing_kept_is_no_loss_and_no_gradient(view: View, average: Any, uncertainty: bool) -> None:
    target = seen_from(view, TRUTH)
    target.depth.zero_()
    view.forward(wall(), se3.exp(OFF) @ TRUTH)
    view.g_sums.fill_(torch.nan)
    config = changed(PAPER, average=average, uncertainty=uncertainty)
    loss, g_exposure = fits_of(view).tracking_loss(view, target, config, EXPOSURE)
    assert loss == 0.0 and g_exposure.tolist() == [0.0, 0.0]
    assert torch.count_nonzero(view.g_sums) == 0  # NaN is not zero


# ---- descent


def descended(view: View, config: TrackingConfig, iterations: int, start: Array = FAR_OFF) -> PoseFit:
    return fit_pose_adam(wall(), view, seen_from(view, TRUTH), se3.exp(start) @ TRUTH, config, iterations)


def test_descent_with_the_papers_numbers_finds_a_pose_again() -> None:
    fit = descended(make_view("cpu", CAMERA, OPTIONS, variance=False), PAPER, 100)
    assert_near(fit.T_camera_world, TRUTH, 1e-3, 0.05)
    # 0.961 at the true pose: the rim of the wall is not opaque, and the target's depths are not divided by opacity.
    # Near it, pixels of the rim change sides with the rounding of the kernels: 0.91 to 0.96.
    assert fit.loss < 0.05 * fit.first_loss and fit.agreement > 0.9 and se3.is_rigid(fit.T_camera_world, 1e-9)


def test_both_backends_descend_alike() -> None:
    found = [descended(make_view(b, CAMERA, OPTIONS), PAPER, 5).T_camera_world for b in ("reference", "cpu")]
    assert_near(found[1], found[0], 1e-4, 1e-2)


def test_axis_angle_holds_where_the_camera_looks_back() -> None:
    """|ω| = π of the camera in the world is no special place for the fit."""
    turn = np.eye(4)
    turn[:3, :3] = np.diag([-1.0, 1.0, -1.0])  # the world turned by π about y: the same scene, another ω
    params = wall().clone()
    params[:, [0, 2]] *= -1.0
    view = make_view("cpu", CAMERA, OPTIONS)
    T_true = TRUTH @ turn
    assert abs(se3.rotation_angle(T_true[:3, :3]) - np.pi) < 0.2
    fit = fit_pose_adam(params, view, seen_from(view, TRUTH), se3.exp(OFF) @ T_true, PAPER, 100)
    assert_near(fit.T_camera_world, T_true, 2e-3, 0.1)


def test_without_a_kept_pixel_the_guess_comes_back(view: View) -> None:
    blind = seen_from(view, TRUTH)
    blind.depth.zero_()
    blind = dataclasses.replace(blind, valid_pixels=0)
    fit = fit_pose_adam(wall(), view, blind, TRUTH, dataclasses.replace(PAPER, uncertainty=True), 3)
    assert_near(fit.T_camera_world, TRUTH, 1e-9, 1e-5)
    assert fit.loss == 0.0 and fit.agreement == fit.overlap == 0.0


def test_an_iterate_that_sees_nothing_does_not_win() -> None:
    """Ten metres off no pixel is kept and the loss is 0: that is no fit."""
    fit = descended(make_view("cpu", CAMERA, OPTIONS), dataclasses.replace(PAPER, lr_translation=10.0), 3, OFF)
    assert_near(fit.T_camera_world, se3.exp(OFF) @ TRUTH, 1e-9, 1e-5)
    assert fit.loss == fit.first_loss > 0.0


# ---- the second frame


@pytest.mark.parametrize(
    ("first", "agreement", "asked"),
    [
        (200, 1.0, [(200, 0.003), (15, 0.0015)]),
        (200, 0.0, [(200, 0.003), (15, 0.0015)]),
        (0, 1.0, [(15, 0.0015), (15, 0.0015)]),
    ],
    ids=["agrees", "disagrees", "off"],
)
def test_the_second_frame_may_take_longer_and_turn_faster(
    monkeypatch: pytest.MonkeyPatch, first: int, agreement: float, asked: list[tuple[int, float]]
) -> None:
    """It alone, whatever becomes of it; a descent is not tried again because map and sensor disagree (papers)."""
    seen: list[tuple[int, float]] = []

    def watched(params: Tensor, view: View, target: Target, T: Array, config: TrackingConfig, n: int) -> PoseFit:
        seen.append((n, config.lr_rotation))
        return PoseFit(T, agreement, 1.0, 0.1, 0.1, n)

    monkeypatch.setattr(tracker, "fit_pose_adam", watched)
    view, field = make_view("reference", CAMERA, OPTIONS), GaussianField(wall())
    target = seen_from(view, TRUTH)
    live = Pyramid.of(gray_of(target.image.numpy()), target.depth_image.numpy(), CAMERA)
    frame = Frame(0, 0.0, target.image.numpy(), target.depth_image.numpy(), CAMERA)
    config = changed(PAPER, iterations=15, first_iterations=first)
    follower = tracker.Tracker(config)
    for _ in range(2):
        follower.track(field.params, view, PreparedFrame(target, live, frame=frame, whole=frame))
    assert seen == asked
