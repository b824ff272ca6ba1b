"""Hold the fused losses and the compiled optimiser to their definitions in torch, float64."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from sigmasplat.fit import losses
from sigmasplat.fit.adam import Rates, adam_step
from sigmasplat.fit.field import CompiledLoss, TorchLoss
from sigmasplat.fit.target import Target
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.frame import Frame
from sigmasplat.render.view import CpuView
from splat_fields import OPTIONS, crowd, params_of
from splat_scenes import SMALL, WIDE, assert_same_vector

_core = pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

WEIGHTS = {"l1": 0.8, "ssim": 0.2, "depth": 1.0, "nll_color": 1e-2, "nll_depth": 2e-2, "isotropy": 1.0}
TERMS = ("l1", "ssim", "depth", "nll_color", "nll_depth")


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
    if len(view.sums) == 7:
        variance = torch.as_tensor(rng.uniform(1e-3, 0.2, color.shape))
        variance[torch.as_tensor(rng.random(color.shape) < 0.1)] = -1e-4
        view.sums[4:] = variance + color**2


def both_ways(camera: Camera, weights: dict[str, float], variance: bool, valid_share: float = 0.8) -> Any:
    """Evaluate fused and by definition: (loss, gradient planes) of each, the image part."""
    view = CpuView(camera, OPTIONS, variance)
    target = target_of(camera, tuple(view.alpha.shape), valid_share)
    draw_planes(view, target)
    exact = SimpleNamespace(sums=view.sums.double(), g_sums=torch.zeros_like(view.sums).double())
    view.g_sums.fill_(torch.nan)  # whatever was there must go
    losses = CompiledLoss(view).images(target, weights), TorchLoss(exact).images(target, weights)
    outside = view.g_sums.clone()
    outside[:, : camera.height, : camera.width] = 0.0
    assert torch.count_nonzero(outside) == 0, "padding must feel nothing"
    crop = (slice(None), slice(camera.height), slice(camera.width))
    return (losses[0], view.g_sums[crop]), (losses[1], exact.g_sums[crop])


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
    assert CompiledLoss(view).images(target, weights) == pytest.approx(0.5 * np.log(losses.NLL_EPS), rel=1e-5)
    assert torch.count_nonzero(view.g_sums) == 0


@pytest.mark.parametrize("n", [1, 7, 8, 513])
def test_adam_follows_torch_for_fifty_steps(isa: str, n: int) -> None:
    rng = np.random.default_rng(n)
    start = params_of(crowd())[:n].contiguous()
    rates = Rates(torch.as_tensor(rng.uniform(1e-4, 5e-2, 17)).float() * (torch.arange(17) != 5))
    compiled, exact = GaussianField(start.clone()), GaussianField(start.double())
    for step in range(1, 51):
        grad = torch.as_tensor(rng.normal(size=(n, 17)) * 10.0 ** rng.uniform(-6, 2, (n, 17))).float()
        grad[:, 2] = 0.0 if step > 10 else 1.0  # coasts on its moments
        grad[:, 3] = 0.0  # never moves: 0 / (0 + ε)
        adam_step(compiled, grad, rates, step, compiled=True)
        adam_step(exact, grad.double(), Rates(rates.per_column.double()), step, compiled=False)
    moved = (exact.params - start).abs()
    assert torch.count_nonzero(moved[:, [3, 5]]) == 0 and torch.equal(compiled.params[:, [3, 5]], start[:, [3, 5]])
    assert float(moved[:, [0, 1, 2, 16]].min()) > 0
    assert_same_vector(compiled.params - start, exact.params - start, 2e-5, f"{isa} steps")
    assert_same_vector(compiled.moment1, exact.moment1, 2e-6, f"{isa} moment1")
    assert_same_vector(compiled.moment2, exact.moment2, 2e-5, f"{isa} moment2")


@pytest.mark.parametrize("n", [1, 7, 8, 513, 2003])
def test_isotropy_follows_its_definition(isa: str, n: int) -> None:
    params = params_of(crowd())[:n].contiguous()
    got = torch.ones_like(params)  # the gradient is added, not written
    value = _core.isotropy(params, 0.7, got)
    leaf = params.double().requires_grad_()
    loss = losses.isotropy(GaussianField(leaf).scales)
    (want,) = torch.autograd.grad(0.7 * loss, leaf)
    assert value == pytest.approx(float(loss.detach()), rel=1e-5)
    # One plus a small gradient in float32: compare what is left of it.
    assert float((got - 1.0 - want).abs().max()) < 2e-7
    exact: Tensor = torch.zeros_like(params)
    _core.isotropy(params, 0.7, exact)
    assert_same_vector(exact, want, what=f"{isa} isotropy")


def test_isotropy_of_balls_and_of_nothing_is_zero(isa: str) -> None:
    params = params_of(crowd())
    params[:, 7:10] = params[:, 7:8]
    gradient = torch.zeros_like(params)
    assert _core.isotropy(params, 1.0, gradient) < 1e-7
    assert float(gradient.abs().max()) < 1e-9
    assert _core.isotropy(params[:0], 1.0, gradient[:0]) == 0.0
