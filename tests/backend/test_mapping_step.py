"""Hold the fused mapping steps, the CPU's and CUDA's, emulated, and Adam to their definitions in torch, float64."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from emulated_cuda import Emulator
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.fit import losses
from sigmasplat.fit.adam import BETA1, BETA2, EPSILON, Rates, adam_step, settle
from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.mapping_step import TorchStep
from splat_fields import crowd, exact_view, params_of, view_on
from splat_fits import RATES, TERMS, WEIGHTS, draw_planes, fields, random_gradient, target_of
from splat_scenes import SMALL, WIDE, assert_same_vector

SIZES = (
    SMALL, WIDE, Camera(65, 33, 60.0, 60.0, 32.0, 16.0), Camera(33, 17, 30.0, 30.0, 15.5, 8.2),
    Camera(16, 16, 20.0, 20.0, 7.5, 7.5),
)  # fmt: skip


def both_ways(
    kernels: str,
    camera: Camera,
    weights: dict[str, float],
    variance: bool,
    valid_share: float = 0.8,
) -> Any:
    """Evaluate fused and by definition: (loss, gradient planes) of each, the image part."""
    view = view_on(kernels, camera, variance)
    target = target_of(camera, tuple(view.alpha.shape), valid_share)
    draw_planes(view, target)
    exact = SimpleNamespace(
        sums=view.sums.double(), g_sums=torch.zeros_like(view.sums).double(), moment=view.moment.double(),
        layers=SimpleNamespace(median_depth=view.layers.median_depth.double()),
        g_moment=torch.zeros_like(view.moment).double(), g_median_depth=torch.zeros_like(view.moment).double(),
        alpha=view.alpha.double(), g_alpha=torch.zeros_like(view.alpha).double(),
    )  # fmt: skip
    needed_by = {"g_sums": "", "g_median_depth": "median_depth", "g_moment": "moment", "g_alpha": "mean_depth"}
    for plane, name in needed_by.items():
        getattr(view, plane).fill_(torch.nan if weights.get(name, 1.0) else 0.0)  # whatever was there must go
    losses = float(fits_of(view).mapping_step(view).images(target, weights)), TorchStep(exact).images(target, weights)
    outside = gradients_of(view)
    outside[:, : camera.height, : camera.width] = 0.0
    assert torch.count_nonzero(outside) == 0, "padding must feel nothing"
    crop = (slice(None), slice(camera.height), slice(camera.width))
    return (losses[0], gradients_of(view)[crop]), (losses[1], gradients_of(exact)[crop])


def gradients_of(view: Any) -> torch.Tensor:
    """Stack the gradient planes: of the sums, of the median depth, of U, of alpha."""
    return torch.cat([view.g_sums, view.g_median_depth[None], view.g_moment[None], view.g_alpha[None]])


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
@pytest.mark.parametrize("camera", SIZES, ids=lambda c: f"{c.width}x{c.height}")
def test_whole_loss_and_its_gradient(every_kernels: str, camera: Camera, variance: bool) -> None:
    (got, gradient), (want, want_gradient) = both_ways(every_kernels, camera, WEIGHTS, variance)
    assert got == pytest.approx(want, rel=1e-5)
    for plane in range(len(gradient)):
        assert_same_vector(gradient[plane], want_gradient[plane], what=f"plane {plane}")


@pytest.mark.parametrize("name", TERMS)
def test_each_term_alone(kernels: str, name: str) -> None:
    weights = dict.fromkeys(WEIGHTS, 0.0) | {name: 0.7}
    (got, gradient), (want, want_gradient) = both_ways(kernels, WIDE, weights, True)
    assert got == pytest.approx(want, rel=1e-5) and abs(got) > 1e-3
    assert_same_vector(gradient, want_gradient, what=name)


@pytest.mark.parametrize("name", TERMS)
def test_a_term_feels_nothing_where_nothing_was_read(kernels: str, name: str) -> None:
    weights = dict.fromkeys(WEIGHTS, 0.0) | {name: 1.0}
    (_, gradient), _ = both_ways(kernels, WIDE, weights, True)
    holes = target_of(WIDE, (WIDE.height, WIDE.width)).depth == 0
    assert int(holes.sum()) > 50 and torch.count_nonzero(gradient[:, holes]) == 0
    assert torch.count_nonzero(gradient) > 100


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
def test_no_valid_pixel_costs_nothing(kernels: str, variance: bool) -> None:
    (got, gradient), (want, _) = both_ways(kernels, WIDE, WEIGHTS, variance, valid_share=0.0)
    assert got == pytest.approx(0.0, abs=1e-6) and want == pytest.approx(0.0, abs=1e-6)
    assert torch.count_nonzero(gradient) == 0


def test_variance_below_zero_is_clamped_and_untrained(kernels: str) -> None:
    weights = dict.fromkeys(WEIGHTS, 0.0) | {"nll_color": 1.0}
    view = view_on(kernels, SMALL)
    target = target_of(SMALL, tuple(view.alpha.shape), 1.0)
    view.sums[:3] = target.color
    view.sums[4:] = target.color**2 - 1e-4
    loss = float(fits_of(view).mapping_step(view).images(target, weights))
    assert loss == pytest.approx(0.5 * np.log(losses.NLL_EPS), rel=1e-5)
    assert torch.count_nonzero(view.g_sums) == 0


SHAPE_TERMS = {"isotropy": 0.7, "isotropy_ratio": 0.01}


def three_steps(view: Any, field: GaussianField, mapping: Any, n: int) -> list[tuple[Any, float, torch.Tensor]]:
    """Step a field at two poses and the first again; return the twist, the cost and the last steps of its rows."""
    pose, results = crowd().T_camera_world.numpy(), []
    for step, turn in enumerate((0.7, -0.5, 0.7)):
        field.steps += 1
        view.forward(field.params, se3.exp(np.array([0, 0, 0, 0, turn, 0])) @ pose)
        random_gradient(view, step)
        twist, cost = mapping.splats(field, RATES, SHAPE_TERMS, n // 3)
        results.append((np.array(twist), float(cost), field.last_step.clone()))
    return results


@cache
def three_exact_steps(n: int) -> tuple[GaussianField, list[tuple[Any, float, torch.Tensor]]]:
    """Make them by the definition, which takes as long as all kernels together, once for all kernels."""
    (_, want), view = fields(n), exact_view(crowd().camera, True)
    return want, three_steps(view, want, TorchStep(view), n)


@pytest.mark.parametrize("n", [0, 7, 16, 17, 700, pytest.param(2003, marks=pytest.mark.slow)])
def test_a_step_follows_its_definition(every_kernels: str, n: int) -> None:
    """Rows, moments, twist and shape terms over three steps, with splats out of view and rows that come back to it."""
    (got, exact), (want, wanted) = fields(n), three_exact_steps(n)
    start, view = exact.params, view_on(every_kernels, crowd().camera)
    found = three_steps(view, got, fits_of(view).mapping_step(view), n)
    for (twist, cost, last), (want_twist, want_cost, want_last) in zip(found, wanted, strict=True):
        assert cost == pytest.approx(want_cost, rel=1e-4)
        assert torch.equal(last, want_last)
        if n:
            assert_same_vector(torch.as_tensor(twist), torch.as_tensor(want_twist), 1e-3, "twist")
    if n:
        assert_same_vector(got.moment1, want.moment1, 1e-3, "moment1")
        assert_same_vector(got.moment2, want.moment2, 1e-3, "moment2")
        assert_same_vector(got.params - start, want.params - start, 5e-3, "steps")
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
def test_settling_follows_its_definition(every_kernels: str, n: int) -> None:
    got, want = fields(n)
    start = want.params.clone()
    settle_by = fits_of(view_on(every_kernels, SMALL)).settle
    settle_by(got, RATES)
    settle(want, Rates(RATES.per_column.double(), RATES.beta2))
    if n > 1:
        assert_same_vector(got.params - start, want.params - start, 1e-3, "steps")
    assert_same_vector(got.moment1, want.moment1, 1e-5, "moment1")
    assert_same_vector(got.moment2, want.moment2, 1e-5, "moment2")
    assert bool((got.last_step == 99).all()) and torch.equal(got.last_step, want.last_step)
    again = got.params.clone()
    settle_by(got, RATES)
    assert torch.equal(got.params, again)


def test_balls_feel_no_isotropy_and_nothing_needs_no_step(every_kernels: str) -> None:
    s = crowd()
    params, view = params_of(s), view_on(every_kernels, s.camera)
    params[:, 7:10] = params[:, 7:8]
    for n in (len(params), 0):
        field = GaussianField(params[:n].contiguous(), steps=1)
        view.forward(field.params, s.T_camera_world.numpy())
        view.g_sums.zero_()
        step = fits_of(view).mapping_step(view)
        twist, cost = step.splats(field, RATES, {"isotropy": 1.0, "isotropy_ratio": 1.0}, 0)
        assert float(cost) < 1e-7 and not twist.any()
        assert float(field.moment1[:, :7].abs().sum()) == 0.0


@pytest.mark.parametrize("order", [1, 2, 3], ids=["warp by warp", "backwards", "shuffled"])
def test_the_order_of_threads_between_barriers_means_nothing(on_the_cpu: Emulator, order: int) -> None:
    (loss, want), _ = both_ways("cuda", WIDE, WEIGHTS, True)
    on_the_cpu.order = order
    (again, got), _ = both_ways("cuda", WIDE, WEIGHTS, True)
    assert loss == again and torch.equal(got, want)
