"""Hold the fused losses and the compiled optimiser to their definitions in torch, float64."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from sigmasplat.fit import losses
from sigmasplat.fit.adam import BETA1, BETA2, EPSILON, Rates, adam_step, settle
from sigmasplat.fit.cpu.adam import settle as settle_compiled
from sigmasplat.fit.cpu.mapping_step import CompiledStep
from sigmasplat.fit.mapping_step import TorchStep
from sigmasplat.fit.target import Target
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.frame import Frame
from sigmasplat.render.cpu.view import CpuView
from sigmasplat.render.reference.view import ReferenceView
from splat_fields import OPTIONS, crowd, exact_view, params_of
from splat_scenes import SMALL, WIDE, assert_same_vector

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

WEIGHTS = {
    "l1": 0.8, "ssim": 0.2, "depth": 1.0, "nll_color": 1e-2, "nll_depth": 2e-2, "median_depth": 0.3, "moment": 0.2,
    "isotropy": 1.0, "isotropy_ratio": 0.1,
}  # fmt: skip
TERMS = ("l1", "ssim", "depth", "nll_color", "nll_depth", "median_depth", "moment")


def target_of(camera: Camera, size: tuple[int, int], valid_share: float = 0.8) -> Target:
    """Draw a frame, with holes in its depth, on planes of `size`."""
    rng = np.random.default_rng(1)
    shape = (camera.height, camera.width)
    depth = rng.uniform(0.5, 4.0, shape) * (rng.random(shape) < valid_share)
    color = rng.uniform(0, 1, (*shape, 3)).astype(np.float32)
    return Target.of(Frame(0, 0.0, color, depth.astype(np.float32), camera), size)


def draw_planes(view: CpuView, target: Target) -> None:
    """Fill a view's planes as a render might: near the target, V from 1e-3 up, one in ten below 0 by rounding."""
    rng = np.random.default_rng(2)
    color = (target.color.double() + 0.2 * torch.as_tensor(rng.normal(size=target.color.shape))).clamp(0, 1)
    view.sums[:3] = color
    view.sums[3] = target.depth + 0.1 * torch.as_tensor(rng.normal(size=target.depth.shape))
    view.layers.median_depth[:] = target.depth + 0.1 * torch.as_tensor(rng.normal(size=target.depth.shape))
    view.layers.median_depth[torch.as_tensor(rng.random(target.depth.shape) < 0.2)] = 0.0
    view.moment[:] = torch.as_tensor(rng.uniform(0.0, 0.1, target.depth.shape))
    if len(view.sums) == 7:
        variance = torch.as_tensor(rng.uniform(1e-3, 0.2, color.shape))
        variance[torch.as_tensor(rng.random(color.shape) < 0.1)] = -1e-4
        view.sums[4:] = variance + color**2


def both_ways(camera: Camera, weights: dict[str, float], variance: bool, valid_share: float = 0.8) -> Any:
    """Evaluate fused and by definition: (loss, gradient planes) of each, the image part."""
    view = CpuView(camera, OPTIONS, variance)
    target = target_of(camera, tuple(view.alpha.shape), valid_share)
    draw_planes(view, target)
    exact = SimpleNamespace(
        sums=view.sums.double(), g_sums=torch.zeros_like(view.sums).double(), moment=view.moment.double(),
        layers=SimpleNamespace(median_depth=view.layers.median_depth.double()),
        g_moment=torch.zeros_like(view.moment).double(), g_median_depth=torch.zeros_like(view.moment).double(),
    )  # fmt: skip
    for plane, name in ((view.g_sums, ""), (view.g_median_depth, "median_depth"), (view.g_moment, "moment")):
        plane.fill_(torch.nan if weights.get(name, 1.0) else 0.0)  # whatever was there must go
    losses = CompiledStep(view).images(target, weights), TorchStep(exact).images(target, weights)
    outside = gradients_of(view)
    outside[:, : camera.height, : camera.width] = 0.0
    assert torch.count_nonzero(outside) == 0, "padding must feel nothing"
    crop = (slice(None), slice(camera.height), slice(camera.width))
    return (losses[0], gradients_of(view)[crop]), (losses[1], gradients_of(exact)[crop])


def gradients_of(view: Any) -> torch.Tensor:
    """Stack the gradient planes: of the sums, of the median depth, of U."""
    return torch.cat([view.g_sums, view.g_median_depth[None], view.g_moment[None]])


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
@pytest.mark.parametrize("camera", [SMALL, WIDE, Camera(65, 33, 60.0, 60.0, 32.0, 16.0)], ids=lambda c: f"{c.width}")
def test_whole_loss_and_its_gradient(isa: str, camera: Camera, variance: bool) -> None:
    (got, gradient), (want, want_gradient) = both_ways(camera, WEIGHTS, variance)
    assert got == pytest.approx(want, rel=1e-5)
    for plane in range(len(gradient)):
        assert_same_vector(gradient[plane], want_gradient[plane], what=f"{isa} plane {plane}")


@pytest.mark.parametrize("name", TERMS)
def test_each_term_alone(name: str) -> None:
    weights = dict.fromkeys(WEIGHTS, 0.0) | {name: 0.7}
    (got, gradient), (want, want_gradient) = both_ways(WIDE, weights, True)
    assert got == pytest.approx(want, rel=1e-5) and abs(got) > 1e-3
    assert_same_vector(gradient, want_gradient, what=name)


@pytest.mark.parametrize("name", TERMS)
def test_a_term_feels_nothing_where_nothing_was_read(name: str) -> None:
    weights = dict.fromkeys(WEIGHTS, 0.0) | {name: 1.0}
    (_, gradient), _ = both_ways(WIDE, weights, True)
    holes = target_of(WIDE, (WIDE.height, WIDE.width)).depth == 0
    assert int(holes.sum()) > 50 and torch.count_nonzero(gradient[:, holes]) == 0
    assert torch.count_nonzero(gradient) > 100


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
def test_no_valid_pixel_costs_nothing(variance: bool) -> None:
    (got, gradient), (want, _) = both_ways(WIDE, WEIGHTS, variance, valid_share=0.0)
    assert got == pytest.approx(0.0, abs=1e-6) and want == pytest.approx(0.0, abs=1e-6)
    assert torch.count_nonzero(gradient) == 0


def test_variance_below_zero_is_clamped_and_untrained() -> None:
    weights = dict.fromkeys(WEIGHTS, 0.0) | {"nll_color": 1.0}
    view = CpuView(SMALL, OPTIONS)
    target = target_of(SMALL, tuple(view.alpha.shape), 1.0)
    view.sums[:3] = target.color
    view.sums[4:] = target.color**2 - 1e-4
    assert CompiledStep(view).images(target, weights) == pytest.approx(0.5 * np.log(losses.NLL_EPS), rel=1e-5)
    assert torch.count_nonzero(view.g_sums) == 0


def fields(n: int) -> tuple[GaussianField, GaussianField]:
    """Make a field and its double, mid-run: moments in motion, rows last moved up to 60 steps ago."""
    rng = np.random.default_rng(n)
    params = params_of(crowd())[:n].contiguous()
    last = torch.as_tensor(rng.choice([99, 99, 99, 80, 40], n), dtype=torch.int32)
    moments = torch.as_tensor(rng.normal(size=(n, 17)) * 1e-3), torch.as_tensor(rng.uniform(1e-9, 1e-5, (n, 17)))
    exact = GaussianField(params.double(), *(m.double() for m in moments), last.clone(), 99)
    return GaussianField(params, *(m.float().contiguous() for m in moments), last, 99), exact


def random_gradient(view: CpuView | ReferenceView, step: int) -> None:
    """Draw image gradients, the same for both views."""
    h, w = view.camera.height, view.camera.width
    drawn = np.random.default_rng(step).normal(size=(len(view.sums), h, w))
    view.g_sums.zero_()
    view.g_sums[:, :h, :w] = torch.as_tensor(drawn).float()


RATES = Rates(torch.linspace(1e-4, 5e-3, 17) * (torch.arange(17) != 5))


@pytest.mark.parametrize("n", [7, 16, 17, 2003])
def test_a_step_follows_its_definition(isa: str, n: int) -> None:
    """Rows, moments, twist and regulariser over three steps, with splats out of view and rows that come back to it."""
    s = crowd()
    (got, want), frozen = fields(n), n // 3
    start, moved = want.params.clone(), exact_view(s.camera, True)
    view = CpuView(s.camera, OPTIONS)
    left, right = (se3.exp(np.array([0, 0, 0, 0, turn, 0])) @ s.T_camera_world.numpy() for turn in (0.7, -0.5))
    for step, T in enumerate((left, right, left)):
        results = []
        for field, v, mapping in ((got, view, CompiledStep(view)), (want, moved, TorchStep(moved))):
            field.steps += 1
            v.forward(field.params, T)
            random_gradient(v, step)
            results.append(mapping.splats(field, RATES, {"isotropy": 0.7}, frozen))
        (twist, regulariser), (want_twist, want_regulariser) = results
        assert_same_vector(torch.as_tensor(twist), torch.as_tensor(want_twist), 1e-3, f"{isa} twist")
        assert regulariser == pytest.approx(want_regulariser, rel=1e-4)
        assert torch.equal(got.last_step, want.last_step)
    assert_same_vector(got.moment1, want.moment1, 1e-3, f"{isa} moment1")
    assert_same_vector(got.moment2, want.moment2, 1e-3, f"{isa} moment2")
    assert_same_vector(got.params - start, want.params - start, 5e-3, f"{isa} steps")
    assert torch.equal(got.params[:, 5], start[:, 5].float()), "a rate of 0 freezes a column"
    if n > 100:
        unseen = want.last_step < 100
        assert 5 < unseen.sum() < n and torch.equal(got.params[unseen], start[unseen].float())


EVEN = Rates(torch.full((17,), 1e-2, dtype=torch.float64))


def test_in_view_at_every_step_it_is_torchs_adam() -> None:
    rng = np.random.default_rng(0)
    field = GaussianField(torch.as_tensor(rng.normal(size=(40, 17))))
    leaf = field.params.clone().requires_grad_()
    theirs = torch.optim.Adam([leaf], lr=1e-2, betas=(BETA1, BETA2), eps=EPSILON)
    for field.steps in range(1, 51):
        gradient = torch.as_tensor(rng.normal(size=(40, 17)) * 10.0 ** rng.uniform(-6, 2, (40, 17)))
        adam_step(field, gradient, EVEN, torch.ones(40, dtype=torch.bool))
        leaf.grad = gradient
        theirs.step()
    torch.testing.assert_close(field.params, leaf.detach(), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("settled", [False, True])
@pytest.mark.parametrize("away", [1, 5, 200])
def test_a_row_that_was_away_ends_where_dense_adam_has_it(away: int, settled: bool) -> None:
    """Coasting and decay are made up for, on its return or by `settle`; the bias correction has worn off by then."""
    rng = np.random.default_rng(away)
    lazy, dense = (GaussianField(torch.zeros(20, 17, dtype=torch.float64)) for _ in range(2))
    everything = torch.ones(20, dtype=torch.bool)
    for step in range(5001, 5031 + away + (not settled)):
        gradient = torch.as_tensor(rng.normal(0.5, 1.0, (20, 17))) * (step < 5031 or step == 5031 + away)
        lazy.steps = dense.steps = step
        adam_step(dense, gradient, EVEN, everything)
        before = lazy.params.clone()
        adam_step(lazy, gradient, EVEN, everything if gradient.any() else ~everything)
        assert gradient.any() or torch.equal(lazy.params, before)
    assert settled == (not torch.equal(lazy.last_step, dense.last_step))
    if settled:
        assert float((dense.params - lazy.params).abs().max()) > 1e-3
        settle(lazy, EVEN)
    torch.testing.assert_close(lazy.params, dense.params, rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(lazy.moment1, dense.moment1, rtol=1e-9, atol=1e-15)
    torch.testing.assert_close(lazy.moment2, dense.moment2, rtol=1e-9, atol=1e-15)
    assert torch.equal(lazy.last_step, dense.last_step)


@pytest.mark.parametrize("n", [1, 16, 2003])
def test_settling_follows_its_definition(isa: str, n: int) -> None:
    got, want = fields(n)
    start = want.params.clone()
    settle_compiled(got, RATES)
    settle(want, Rates(RATES.per_column.double()))
    if n > 1:
        assert_same_vector(got.params - start, want.params - start, 1e-3, f"{isa} steps")
    assert_same_vector(got.moment1, want.moment1, 1e-5, f"{isa} moment1")
    assert_same_vector(got.moment2, want.moment2, 1e-5, f"{isa} moment2")
    assert bool((got.last_step == 99).all()) and torch.equal(got.last_step, want.last_step)
    again = got.params.clone()
    settle_compiled(got, RATES)
    assert torch.equal(got.params, again)


def test_balls_feel_no_isotropy_and_nothing_needs_no_step(isa: str) -> None:
    s = crowd()
    params, view = params_of(s), CpuView(s.camera, OPTIONS)
    params[:, 7:10] = params[:, 7:8]
    for n in (len(params), 0):
        field = GaussianField(params[:n].contiguous(), steps=1)
        view.forward(field.params, s.T_camera_world.numpy())
        view.g_sums.zero_()
        twist, regulariser = CompiledStep(view).splats(field, RATES, {"isotropy": 1.0, "isotropy_ratio": 1.0}, 0)
        assert regulariser < 1e-7 and not twist.any()
        assert float(field.moment1[:, :7].abs().sum()) == 0.0
