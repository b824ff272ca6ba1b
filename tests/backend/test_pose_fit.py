"""fit_pose by descent: its gradient is that of the loss as the paper writes it, and it finds a pose again."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from constants import changed
from paper_settings import RegistrationConfig, TrackingConfig, paper_settings
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.descent import by_texture, descend
from sigmasplat.fit.pose import PoseFit, fit_pose_adam
from sigmasplat.fit.target import Target, textured
from sigmasplat.graph.registration import tracking_of
from sigmasplat.render import render
from sigmasplat.render.backend import make_view
from sigmasplat.render.view import View
from splat_fields import OPTIONS
from splat_scenes import assert_same_vector, twist_gradient
from splat_wall import CAMERA, TRUTH, Array, assert_near, lower_median, seen_from, wall

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

OFF = np.array([0.012, -0.015, 0.01, 0.012, -0.008, 0.015])
STEPS = TrackingConfig(lr_rotation=4e-4, lr_translation=1e-3)
PLAIN = torch.zeros(2)


@pytest.fixture(params=["reference", "cpu"])
def view(request: pytest.FixtureRequest) -> View:
    return make_view(request.param, CAMERA, OPTIONS)


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
    loss, g_exposure = fits_of(view).tracking_loss(view, target, config, exposure)
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
    fits_of(view).tracking_loss(view, target, TrackingConfig(tau=1.0), PLAIN)
    assert torch.count_nonzero(view.g_sums[4:]) == 0 and torch.count_nonzero(view.g_alpha) == 0
    outside = view.g_sums.clone()
    outside[:, :h, :w] = 0.0
    assert torch.count_nonzero(outside) == 0, "padding must feel nothing"


def test_no_gradient_where_there_is_no_reading(view: View) -> None:
    target, h, w = damaged(view), CAMERA.height, CAMERA.width
    view.forward(wall(), TRUTH)
    fits_of(view).tracking_loss(view, target, TrackingConfig(outlier_factor=0.0), PLAIN)
    unread = target.depth_image == 0
    assert unread.sum() > 100 and torch.count_nonzero(view.g_sums[:, :h, :w][:, unread]) == 0
    assert torch.count_nonzero(view.g_sums[:, :h, :w][:, ~unread]) > 1000


def test_the_twist_is_the_loss_differentiated_by_the_pose_through_the_renderer(view: View) -> None:
    """Frozen weights, everything else through `render` and autograd: the sign and frame of the pose step."""
    target, config, h, w = damaged(view), TrackingConfig(tau=2.0), CAMERA.height, CAMERA.width
    T_start = se3.exp(OFF) @ TRUTH
    view.forward(wall(), T_start)
    fits_of(view).tracking_loss(view, target, config, PLAIN)
    twist = view.backward_pose(wall())
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
    config = changed(STEPS, exposure=True, lr_exposure=4e-3)
    fit = fit_pose_adam(wall(), view, target, se3.exp(0.3 * OFF) @ TRUTH, config, 90)
    np.testing.assert_allclose(fit.exposure, (0.1, 0.03), atol=0.015)
    assert_near(fit.T_camera_world, TRUTH, 2e-3, 0.1)
    assert fit_pose_adam(wall(), view, target, TRUTH, STEPS, 5).exposure == (0.0, 0.0)


@pytest.mark.parametrize(("method", "share"), [("paper", 0.5), ("code", 0.95)])
@pytest.mark.parametrize("tracked", [TrackingConfig(), TrackingConfig(average="kept")])
def test_registration_minimises_the_loss_of_the_paper(
    tracked: TrackingConfig, method: str, share: float, view: View
) -> None:
    """VarSplat §5: means over all pixels, of colour over its channels too; no setting of tracking changes the loss. The
    text has no λ; the code has 0.95, and colour with the median of V only where the image has texture."""
    target, params = damaged(view), wall()
    params[::3, 10] = 0.0  # some splats are half transparent
    view.forward(params, TRUTH)
    h, w = CAMERA.height, CAMERA.width
    config = paper_settings(registration=RegistrationConfig(method=method), tracking=tracked)
    chosen = torch.ones(h, w, dtype=torch.bool)
    if config.registration.textured:
        chosen = torch.rand(h, w, generator=torch.Generator().manual_seed(5)) < 0.3
        target = dataclasses.replace(target, textured=target.with_depth((target.depth_image * chosen).numpy()))
    by_texture(fits_of(view).tracking_loss, view, target, tracking_of(config), PLAIN)
    sums = view.sums[:, :h, :w].clone().requires_grad_()
    maps, alpha = sums.double(), view.alpha[:h, :w].double()
    used = (target.depth_image > 0) & (alpha > 0.95)
    in_color = used & chosen
    log = ((maps[4:] - maps[:3] ** 2).detach().clamp(min=0) + 1e-6).log()
    weights = torch.stack([torch.exp(-(one - lower_median(one[in_color])) / 50.0) for one in log]).clamp(1 / 3, 3)
    color = (in_color * alpha * weights * (maps[:3] - target.image.movedim(-1, 0)).abs()).mean()
    depth = (used * alpha * (maps[3] - target.depth_image).abs()).mean()
    (share * color + (1 - share) * depth).backward()
    assert sums.grad is not None and 0 < int(used.sum()) < h * w
    got, want = view.g_sums[:4, :h, :w].flatten().double(), sums.grad[:4].flatten().double()
    torch.testing.assert_close(got / got.norm(), want / want.norm(), rtol=1e-4, atol=1e-7)


def test_texture_is_much_more_gradient_than_a_block_has() -> None:
    ramp = np.linspace(0.2, 0.8, 320, dtype=np.float32) * np.ones((256, 1), np.float32)
    image = np.repeat(ramp[..., None], 3, 2)
    assert not textured(image).any()
    image[:, 105] += 0.2
    columns = np.flatnonzero(textured(image).all(0))
    assert columns.tolist() == [104, 106] and textured(image).sum() == 2 * 256
    image[100:110] = 0.0
    assert not textured(image)[99:111].any()


def test_descent_that_stands_still_stops(view: View) -> None:
    crawling = dataclasses.replace(STEPS, lr_rotation=1e-9, lr_translation=1e-9)
    assert descended(view, crawling, iterations=9).iterations == 9
    flat = changed(crawling, plateau_stop=1e-3, plateau_window=4)
    assert descended(view, flat, iterations=9).iterations == 5


def test_descent_goes_on_after_one_step_without_progress() -> None:
    """Two equal losses are no plateau; as many steps without progress as the window has are one."""
    view, losses = make_view("reference", CAMERA, OPTIONS), iter([9.0, 9.0, 8.0, 8.5, 7.0, 7.0, 7.0, 7.0, 1.0])

    def scripted(*_: object) -> tuple[float, torch.Tensor]:
        view.g_sums.zero_()
        return next(losses), torch.zeros(2)

    config = changed(STEPS, plateau_stop=1e-4, plateau_window=3)
    found = descend(wall(), view, seen_from(view, TRUTH), TRUTH, config, 9, scripted)
    assert (found.steps, found.loss) == (8, 7.0)
