"""Hold what the maps of depth feel - U, the median depth - and the pull at image means to the definition and to finite
differences."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from paper_settings import MappingConfig
from sigmasplat.data import se3
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.fit import losses
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.cpu import CompiledStep
from sigmasplat.fit.field import fit_field, loss_weights
from sigmasplat.fit.mapping_step import TorchStep
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.render import reference
from sigmasplat.render.cpu import CpuView
from sigmasplat.render.reference import ReferenceView
from sigmasplat.render.view import View
from splat_fields import OPTIONS, Gradients, crowd, exact_view, params_of, plane_gradients
from splat_scenes import KINDS, WIDE, Scene, assert_same_vector, scene

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

CG = MappingConfig(
    weight_isotropy=0.0, weight_nll_color=0.0, weight_l1=0.7, weight_ssim=0.1, weight_depth=0.25, weight_alignment=0.25,
    weight_isotropy_ratio=0.1, weight_moment=0.15,
)  # fmt: skip
WEIGHTS = loss_weights(replace(CG, weight_mean_depth=0.5))
RATES = Rates(torch.linspace(1e-4, 5e-3, 17))


def carried(view: View, params: Tensor, s: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Render with U and layers, draw gradients on every plane; return rows, pull, twist.

    Pixels where two splats may be the median one by rounding are left out: those near half transmittance.
    """
    h, w = s.camera.height, s.camera.width
    view.forward(params, s.T_camera_world.numpy(), s.ref_depth.to(params), layers=True)
    drawn, extra = plane_gradients(s.camera, len(view.sums)), plane_gradients(s.camera, 2, seed=4)[0]
    planes = (view.g_sums, view.g_alpha, view.g_moment, view.g_median_depth)
    for plane in planes:
        plane.zero_()
    view.g_sums[:, :h, :w], view.g_alpha[:h, :w] = drawn
    view.g_moment[:h, :w], view.g_median_depth[:h, :w] = extra[0], extra[1]
    rows, pull = torch.full_like(params, torch.nan), torch.full_like(params[:, 0], torch.nan)
    twist = view.backward(params, rows, pull)
    return rows, pull, torch.as_tensor(twist.copy())


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
@pytest.mark.parametrize("kind", KINDS)
def test_rows_pull_and_twist_follow_the_definition(kind: str, variance: bool) -> None:
    s = scene(kind, 60)
    params = params_of(s)
    got = carried(CpuView(s.camera, OPTIONS, variance), params, s)
    want = carried(exact_view(s.camera, variance), params.double(), s)
    for name, columns in COLUMNS.items():
        if variance or name != "log_variances":
            assert_same_vector(got[0][:, columns], want[0][:, columns], what=name)
    assert_same_vector(got[1], want[1], what="pull")
    assert_same_vector(got[2], want[2], what="twist")


MANY = 700
"""Splats of a crowd: the definition takes as long for each."""


@cache
def exact_crowd() -> tuple[Tensor, Tensor, Tensor]:
    """Return what the definition, which is slow, carries for a crowd."""
    s = crowd(count=MANY)
    return carried(exact_view(s.camera, True), params_of(s).double(), s)


def test_many_splats_on_threads(isa: str) -> None:
    s, want = crowd(count=MANY), exact_crowd()
    got = carried(CpuView(s.camera, OPTIONS), params_of(s), s)
    for name, columns in COLUMNS.items():
        assert_same_vector(got[0][:, columns], want[0][:, columns], 1e-3, f"{isa} {name}")
    assert_same_vector(got[1], want[1], 1e-3, "pull")


def test_planes_not_made_are_not_felt() -> None:
    """A render without layers or a depth ignores whatever their gradient planes still hold."""
    s = scene("random", 60)
    params, results = params_of(s), []
    for stale in (0.0, 7.0):
        view = CpuView(s.camera, OPTIONS)
        view.g_moment.fill_(stale)
        view.g_median_depth.fill_(stale)
        view.forward(params, s.T_camera_world.numpy())
        view.g_sums.fill_(1e-2)
        rows = torch.empty_like(params)
        view.backward(params, rows)
        results.append(rows)
    assert torch.equal(*results)


def seen(s: Scene, size: tuple[int, int], valid_share: float = 0.8) -> Target:
    """Draw a target near a scene's own depth, with holes."""
    rng = np.random.default_rng(1)
    depth = s.ref_depth.numpy() * (rng.random(s.ref_depth.shape) < valid_share)
    color = rng.uniform(0, 1, (*depth.shape, 3)).astype(np.float32)
    return Target.of(Frame(0, 0.0, color, depth.astype(np.float32), s.camera), size)


def loss_of(view: ReferenceView, rows: Tensor, T: np.ndarray, target: Target, name: str) -> float:
    """Cost one term of a field at a pose, in float64."""
    step = TorchStep(view)
    weights = dict.fromkeys(WEIGHTS, 0.0) | {name: 1.0}
    step.forward(GaussianField(rows), T, target, weights)
    return step.images(target, weights)


def difference(f: Callable[[float], float], h: float) -> float:
    """Differentiate at 0 by central differences of fourth order."""
    return (8.0 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12.0 * h)


@pytest.mark.parametrize("name", ["median_depth", "moment", "mean_depth"])
def test_each_new_term_by_finite_differences(name: str) -> None:
    """Along random directions of rows and pose, in double; steps so small that no pixel changes its median splat."""
    s = scene("random", 12)
    params, T, view = params_of(s).double(), s.T_camera_world.numpy(), exact_view(s.camera, True)
    target = seen(s, tuple(view.alpha.shape))
    target.color, target.depth = target.color.double(), target.depth.double()
    assert loss_of(view, params, T, target, name) > 1e-3
    assert bool(view.g_alpha.any()) == (name == "mean_depth"), "the mean D̂/A depends on alpha"
    rows = torch.empty_like(params)
    twist = view.backward(params, rows)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        along, xi = torch.as_tensor(rng.normal(size=params.shape)), rng.normal(size=6)

        def moved(h: float, along: Tensor = along) -> float:
            return loss_of(view, params + h * along, T, target, name)

        def turned(h: float, xi: np.ndarray = xi) -> float:
            return loss_of(view, params, se3.exp(h * xi) @ T, target, name)

        by_rows, by_pose = difference(moved, 1e-6), difference(turned, 1e-6)
        assert float((rows * along).sum()) == pytest.approx(by_rows, rel=1e-4, abs=1e-8)
        assert float(twist @ xi) == pytest.approx(by_pose, rel=1e-4, abs=1e-8)


def test_isotropy_ratio_by_finite_differences_and_by_hand() -> None:
    scales = torch.as_tensor(np.random.default_rng(0).uniform(0.5, 2.0, (9, 3))).requires_grad_()
    assert torch.autograd.gradcheck(losses.isotropy_ratio, (scales,))
    assert float(losses.isotropy_ratio(torch.tensor([[1.0, 2.0, 4.0], [3.0, 3.0, 3.0]]))) == pytest.approx(1.5)
    round_ones = torch.full((4, 3), 0.3, requires_grad=True)
    losses.isotropy_ratio(round_ones.log().exp()).backward()
    assert round_ones.grad is not None and float(round_ones.grad.sum(1).abs().max()) < 1e-6
    assert float(losses.isotropy_ratio(torch.zeros(0, 3))) == 0.0


def test_alignment_pulls_both_sides_and_only_where_there_is_a_median() -> None:
    depth, median = torch.full((4, 4), 2.0, requires_grad=True), torch.full((4, 4), 2.5)
    median[0] = 0.0
    median.requires_grad_()
    valid = torch.ones(4, 4, dtype=torch.bool)
    valid[1] = False
    value = losses.median_depth(depth, median, valid)
    value.backward()
    assert float(value.detach()) == pytest.approx(0.5 * 8 / 12), "a mean over valid pixels"
    assert depth.grad is not None and median.grad is not None
    assert torch.equal(depth.grad, -median.grad)
    assert torch.count_nonzero(depth.grad[:2]) == 0 and torch.count_nonzero(depth.grad[2:]) == 8


def test_mean_depth_does_not_depend_on_how_opaque_the_splats_of_one_depth_are() -> None:
    """D̂ of a half transparent wall is too small, and its loss pulls; D̂/A is the depth of the wall."""
    depth, alpha = torch.full((3, 4), 1.2, requires_grad=True), torch.full((3, 4), 0.6, requires_grad=True)
    valid, target = torch.ones(3, 4, dtype=torch.bool), torch.full((3, 4), 2.0)
    assert float(losses.mean_depth(depth, alpha, target, valid).detach()) == pytest.approx(0.0, abs=1e-6)
    assert float(losses.depth(depth, target, valid).detach()) == pytest.approx(0.8)
    thin = torch.full((3, 4), 0.5)
    assert float(losses.mean_depth(0.9 * depth, thin, target, valid).detach()) == 0.0, "no depth where alpha is small"
    value = losses.mean_depth(1.1 * depth, alpha, target, valid)
    value.backward()
    assert depth.grad is not None and alpha.grad is not None
    torch.testing.assert_close(alpha.grad, torch.full((3, 4), -1.32 / 0.36 / 12))


def test_a_fit_without_mean_depth_ignores_what_another_fit_left_on_alpha() -> None:
    s = scene("random", 60)
    config, rows = MappingConfig(weight_isotropy=0.0), []
    for stale in (0.0, 7.0):
        view, field = CpuView(s.camera, OPTIONS), GaussianField(params_of(s))
        view.g_alpha.fill_(stale)
        fit_field(field, view, [keyframes_of(s, view, (0.0, 0.2))], config)
        rows.append(field.params)
    assert torch.equal(*rows)


def stepped(view: View, rows: Tensor, step: CompiledStep | TorchStep) -> tuple[Tensor, Tensor, Tensor, float, float]:
    """Return gradient, twist, pull, loss and what the shape terms cost of one step with every term."""
    s = crowd()
    T = se3.exp(np.array([0, 0, 0, 0, 0.4, 0])) @ s.T_camera_world.numpy()
    target = seen(s, tuple(view.alpha.shape))
    if rows.dtype == torch.float64:
        target.color, target.depth = target.color.double(), target.depth.double()
    field, pull = GaussianField(rows, steps=1), torch.zeros_like(rows[:, 0])
    step.forward(field, T, target, WEIGHTS)
    loss = step.images(target, WEIGHTS)
    twist, cost = step.splats(field, RATES, WEIGHTS, 0, pull)
    return field.moment1, torch.as_tensor(np.array(twist)), pull, loss, cost


@cache
def exact_step(n: int) -> tuple[Tensor, Tensor, Tensor, float, float]:
    """Make it by the definition, which is slow, once for all instruction sets."""
    view = exact_view(crowd().camera, True)
    return stepped(view, params_of(crowd())[:n].double(), TorchStep(view))


@pytest.mark.parametrize("n", [16, 17, 700, pytest.param(2003, marks=pytest.mark.slow)])
def test_a_step_with_every_term_follows_its_definition(isa: str, n: int) -> None:
    """Rows, twist, pull and what the shape terms cost, with splats out of view."""
    view, want = CpuView(crowd().camera, OPTIONS), exact_step(n)
    got = stepped(view, params_of(crowd())[:n].contiguous(), CompiledStep(view))
    for k, what in enumerate(("gradient", "twist", "pull")):
        assert_same_vector(got[k], want[k], 2e-3, f"{isa} {what}")
    assert got[3] == pytest.approx(want[3], rel=1e-4) and got[4] == pytest.approx(want[4], rel=1e-4)
    assert got[4] > 1e-2, "the splats are not round"


def keyframes_of(s: Scene, view: View, turns: tuple[float, ...]) -> list[Keyframe]:
    target, T = seen(s, tuple(view.alpha.shape)), s.T_camera_world.numpy()
    return [
        Keyframe(k, target, se3.inverse(se3.exp(np.array([0, 0, 0, 0, turn, 0])) @ T)) for k, turn in enumerate(turns)
    ]


@pytest.mark.parametrize("backend", [CpuView, ReferenceView])
def test_a_batch_descends_the_mean_loss(backend: type) -> None:
    """Adam's first moment is 0.1 of the gradient: that of a batch is the mean of those of its images alone."""
    s = scene("random", 60, WIDE)
    config = replace(CG, weight_isotropy_ratio=0.0)
    view = backend(s.camera, OPTIONS)
    keyframes, alone = keyframes_of(s, view, (0.0, 0.2, -0.3)), []
    for keyframe in keyframes:
        field = GaussianField(params_of(s))
        fit_field(field, view, [[keyframe]], config)
        alone.append((field.moment1, field.last_step > 0))
    together = GaussianField(params_of(s))
    fit = fit_field(together, view, [keyframes], config)
    assert_same_vector(together.moment1, sum(m for m, _ in alone) / 3, 1e-4, "gradient")
    seen_by_any = torch.stack([v for _, v in alone]).any(0)
    assert torch.equal(together.params != params_of(s), (together.moment1 != 0)) and len(fit.losses) == 1
    assert bool((together.last_step[seen_by_any] == 1).all())


def test_statistics_receive_every_gradient_and_movable_poses_move() -> None:
    s = scene("random", 60, WIDE)
    view, stats = CpuView(s.camera, OPTIONS), Gradients()
    keyframes = keyframes_of(s, view, (0.0, 0.2))
    keyframes[0].movable = False
    before = [k.T_world_camera.copy() for k in keyframes]
    config = MappingConfig(lr_pose_translation=1e-3, lr_pose_rotation=1e-3)
    fit_field(GaussianField(params_of(s)), view, [keyframes, [keyframes[1]]], config, stats=stats)
    assert [index for index, _ in stats.given] == [0, 1, 1] and all(grad2d.sum() > 0 for _, grad2d in stats.given)
    assert np.array_equal(before[0], keyframes[0].T_world_camera)
    assert not np.array_equal(before[1], keyframes[1].T_world_camera)


def test_median_depth_is_felt_by_one_splat_alone() -> None:
    """Two sheets: half the light is gone at the near one, so only its splats' depths feel the median's gradient."""
    s = scene("overlapping", 60)
    params, view = params_of(s), CpuView(s.camera, OPTIONS)
    view.forward(params, s.T_camera_world.numpy(), layers=True)
    view.g_sums.zero_()
    view.g_median_depth.zero_()
    ids = view.layers.median_id[: s.camera.height, : s.camera.width]
    y, x = (int(i[0]) for i in torch.where(ids >= 0))
    view.g_median_depth[y, x] = 1.0
    rows = torch.empty_like(params)
    twist = view.backward(params, rows)
    owner = int(ids[y, x])
    assert rows.abs().sum(1).nonzero().squeeze(1).tolist() == [owner]
    R = s.T_camera_world.numpy()[:3, :3]
    np.testing.assert_allclose(rows[owner, :3].numpy(), R[2], atol=1e-6)
    assert twist[2] == pytest.approx(1.0, rel=1e-6) and abs(twist[0]) + abs(twist[1]) < 1e-9
    assert reference.ALPHA_MAX < 1.0
