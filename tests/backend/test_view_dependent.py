"""The step of view-dependent colour: its gradients against finite differences, kernels against the definition."""

from collections.abc import Callable
from copy import deepcopy
from itertools import repeat

import numpy as np
import pytest
import torch
from torch import Tensor

from paper_settings import MappingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField, Rows
from sigmasplat.data.frame import Frame
from sigmasplat.data.harmonics import count
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.backends import fits_of, step_for
from sigmasplat.fit.field import fit_field, loss_weights
from sigmasplat.fit.mapping_step import TorchStep, ViewDependentStep
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.render import render
from sigmasplat.render.cpu import CpuView
from sigmasplat.render.reference import ReferenceView
from sigmasplat.render.view import View
from splat_fields import OPTIONS, exact_view, params_of, plane_gradients
from splat_scenes import SMALL, WIDE, Scene, assert_same_vector, scene

DESCENT = Rates(torch.full((17,), 1e-3, dtype=torch.float64))
CAMERA = Camera(32, 24, 28.0, 28.0, 15.5, 11.5)


def shiny(s: Scene, dtype: torch.dtype = torch.float64) -> GaussianField:
    """Make a scene's field with harmonics, halfway through a fit."""
    params = params_of(s)
    k = torch.as_tensor(np.random.default_rng(8).normal(0, 0.2, (len(params), 45))).float()
    return GaussianField(params.to(dtype), steps=1, attributes={"harmonics": Rows(k.to(dtype))})


def draw_gradients(view: View) -> None:
    h, w = view.camera.height, view.camera.width
    view.g_sums.zero_()
    view.g_alpha.zero_()
    g_sums, _ = plane_gradients(view.camera, len(view.sums))
    view.g_sums[:, :h, :w] = g_sums


def target_of(view: View) -> Target:
    """Make a black image without depth: a first step of no weight needs one, and looks at nothing of it."""
    size, c = view.alpha.shape, view.camera
    return Target(c, torch.zeros(3, *size), torch.zeros(size), 0)


def gradients(field: GaussianField, view: View, T: np.ndarray, degree: int) -> tuple[Tensor, Tensor, Tensor]:
    """Read the gradients [N, 17], [N, 45] of a first step off Adam's first moments (0.1 g), and the twist [6]."""
    fits = fits_of(view)
    step = fits.view_dependent_step(fits.mapping_step(view), degree)
    step.forward(field, T, target_of(view), {})
    draw_gradients(view)
    twist, _ = step.splats(field, Rates(DESCENT.per_column.to(field.params)), {}, 0)
    return field.moment1 * 10, field.attributes["harmonics"].moment1 * 10, torch.as_tensor(twist)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_gradients_are_those_of_finite_differences(degree: int) -> None:
    """Through `render`, which knows nothing of the step: harmonics, means, colours, variances, and the pose."""
    s = scene("random", 12, SMALL)
    T, view = s.T_camera_world.numpy(), exact_view(SMALL, True)
    found = gradients(shiny(s), view, T, degree)
    weights = view.g_sums.movedim(0, -1)
    rng = np.random.default_rng(1)

    def value(rows: Tensor, k: Tensor, twist: Tensor) -> float:
        field = shiny(s)
        field.params += rows
        field.attributes["harmonics"].params += k
        field.attributes["harmonics"].params[:, 3 * count(degree) :] = 0.0
        seen = render(field, SMALL, torch.as_tensor(se3.exp(twist.numpy()) @ T), options=OPTIONS, backend="reference")
        second = seen.variance + seen.color**2
        return float((torch.cat([seen.color, seen.depth[..., None], second], -1) * weights).sum())

    nothing = (torch.zeros_like(found[0]), torch.zeros_like(found[1]), torch.zeros(6).double())
    kernels = on_kernels(lambda: gradients(shiny(s, torch.float32), CpuView(SMALL, OPTIONS), T, degree))
    for part, columns in [(0, c) for c in COLUMNS.values()] + [(1, slice(0, 3 * count(degree))), (2, slice(0, 6))]:
        direction = torch.zeros_like(nothing[part])
        direction[..., columns] = torch.as_tensor(rng.normal(size=direction[..., columns].shape))
        ends = []
        for sign in (1, -1):
            moved = list(nothing)
            moved[part] = sign * 1e-6 * direction
            ends.append(value(*moved))
        want = (ends[0] - ends[1]) / 2e-6
        got = float((found[part] * direction).sum())
        assert got == pytest.approx(want, rel=1e-6, abs=1e-7) and abs(want) > 1e-3
        for isa, of_kernels in kernels.items():
            assert float((of_kernels[part].double() * direction).sum()) == pytest.approx(want, rel=1e-4), isa
    assert torch.count_nonzero(found[1][:, 3 * count(degree) :]) == 0, "degrees not in use are left alone"


def on_kernels(work: Callable[[], tuple[Tensor, ...]]) -> dict[str, tuple[Tensor, ...]]:
    """Return the results of some work on the kernels of each instruction set that this processor supports."""
    try:
        from sigmasplat.native import _core
    except ImportError:
        return {}
    before, found = _core.isa_name(), {}
    for isa in _core.supported_isas():
        _core.set_isa(isa)
        found[isa] = work()
    _core.set_isa(before)
    return found


@pytest.mark.parametrize("kind", ["random", "near_plane", "off_screen"])
def test_both_backends_agree(isa: str, kind: str) -> None:
    s = scene(kind, 60)
    T, exact, kernels = s.T_camera_world.numpy(), exact_view(WIDE, True), CpuView(WIDE, OPTIONS)
    want, got = gradients(shiny(s), exact, T, 3), gradients(shiny(s, torch.float32), kernels, T, 3)
    for a, b, what in zip(got, want, ("rows", "harmonics", "twist"), strict=True):
        assert_same_vector(a, b, 1e-3, what)
    h, w = WIDE.height, WIDE.width
    assert float((kernels.sums[:, :h, :w] - exact.sums).abs().max()) < 1e-4 * float(exact.sums.abs().max())


def views() -> list[View]:
    try:
        return [ReferenceView(CAMERA, OPTIONS), CpuView(CAMERA, OPTIONS)]
    except ImportError:
        return [ReferenceView(CAMERA, OPTIONS)]


def shiny_wall(n: int = 120) -> GaussianField:
    rng = np.random.default_rng(0)
    means = np.stack([rng.uniform(-1.2, 1.2, n), rng.uniform(-0.9, 0.9, n), 2 + 0.1 * rng.normal(size=n)], 1)
    values = [torch.as_tensor(v).float() for v in (means, np.full(n, 0.12), rng.uniform(0.3, 0.7, (n, 3)))]
    field = GaussianField.from_values(*values, opacities=0.9)
    k = torch.zeros(n, 45)
    k[:, :9] = torch.as_tensor(rng.normal(0, 0.4, (n, 9)))
    field.attributes["harmonics"] = Rows(k)
    return field


def seen_from(field: GaussianField, T_world_camera: np.ndarray, view: View) -> Keyframe:
    """Show a field to a camera: a keyframe without noise."""
    seen = render(field, CAMERA, torch.as_tensor(se3.inverse(T_world_camera)), options=OPTIONS, backend="reference")
    color = seen.color.clamp(0, 1).numpy().copy()
    frame = Frame(0, 0.0, color, np.where(seen.alpha > 0.5, seen.depth, 0.0).astype(np.float32), CAMERA)
    return Keyframe(0, Target.of(frame, (view.alpha.shape[0], view.alpha.shape[1])), T_world_camera)


def walk() -> list[np.ndarray]:
    """Return six poses along an arc, looking at the wall."""
    around = [se3.exp(np.array([0, 0, 0, 0, a, 0.0])) for a in np.linspace(-0.8, 0.8, 6)]
    center = np.eye(4)
    center[2, 3] = 2.0
    return [center @ R @ se3.inverse(center) for R in around]


def test_harmonics_learn_a_colour_that_depends_on_the_view() -> None:
    """Plain colours cannot follow it, harmonics can; what has no rate stays."""
    true, view = shiny_wall(), views()[-1]
    keyframes = [seen_from(true, T, view) for T in walk()]
    rates = Rates(torch.zeros(17))
    rates.per_column[COLUMNS["colors"]] = 0.02
    config = MappingConfig(weight_nll_color=0.0, weight_isotropy=0.0, weight_depth=0.0)
    losses = []
    for degree in (0, 1, 2):
        field = GaussianField(true.params.clone())
        field.params[:, COLUMNS["colors"]] = 0.5
        fit = fit_field(field, view, [[keyframes[i % 6]] for i in range(120)], config, repeat(rates), degree=degree)
        losses.append(np.mean(fit.losses[-6:]))
        assert ("harmonics" in field.attributes) == (degree > 0)
        assert torch.equal(field.params[:, :11], true.params[:, :11])
    assert losses[1] < 0.85 * losses[0] and losses[2] < 0.55 * losses[0]


def test_fits_agree_on_both_backends() -> None:
    """Ten steps with every term on, from one start, rows out of view among them."""
    pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    true, fields = shiny_wall(), []
    for view in views():
        field = GaussianField(true.params.clone())
        order = [seen_from(true, T, view) for T in (*walk(), *walk()[:4])]
        fit = fit_field(field, view, [[k] for k in order], MappingConfig(weight_nll_color=1e-2), degree=2)
        fields.append((field, fit.losses))
    (a, losses_a), (b, losses_b) = fields
    np.testing.assert_allclose(losses_a, losses_b, rtol=2e-2)
    # Shapes are left out: of balls, a rotation's gradient is rounding, and Adam's first steps follow its sign.
    colors = COLUMNS["colors"]
    for x, y in ((a.colors - true.params[:, colors], b.colors - true.params[:, colors]),
                 (a.attributes["harmonics"].params, b.attributes["harmonics"].params)):  # fmt: skip
        assert 0 < float((x - y).norm()) < 0.1 * float(y.norm())
    assert a.attributes["harmonics"].steps == 10 and losses_a[-1] < losses_a[4]


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_steps_of_the_kernels_are_those_of_torch(isa: str, degree: int) -> None:
    """Compare the harmonics, moments and steps after eight views, of which each shows only a part of the splats."""
    fields, cameras = [], [se3.exp(np.array([0.9 * side, 0, 0, 0, 0, 0.0])) for side in (-1, 1, 1, -1, -1, 1, 1, -1)]
    for fused in (False, True):
        view, field = CpuView(CAMERA, OPTIONS), shiny_wall()
        step = (
            fits_of(view).view_dependent_step(TorchStep(view), degree)
            if fused
            else ViewDependentStep(TorchStep(view), degree)
        )
        rates = Rates(torch.zeros(17))
        rates.per_column[COLUMNS["colors"]] = 0.02
        for T in cameras:
            field.steps += 1
            step.forward(field, T, target_of(view), {})
            draw_gradients(view)
            twist, _ = step.splats(field, rates, {}, 20)
        fields.append((field, torch.as_tensor(twist)))
    (want, want_twist), (got, got_twist) = fields
    h, k = want.attributes["harmonics"], got.attributes["harmonics"]
    assert torch.equal(h.last_step, k.last_step) and len(h.last_step.unique()) > 1, "some rows were not in every view"
    assert h.steps == k.steps == len(cameras)
    started = shiny_wall().attributes["harmonics"].params
    for a, b, what in ((k.params - started, h.params - started, "harmonics"), (k.moment1, h.moment1, "moment1"),
                       (k.moment2, h.moment2, "moment2"), (got.params, want.params, "rows")):  # fmt: skip
        assert_same_vector(a, b, 2e-4, f"{isa} {what}")
        assert torch.count_nonzero(b) > 0
    assert_same_vector(got_twist, want_twist, 1e-4, f"{isa} twist")
    used = 3 * count(degree)
    assert torch.equal(k.params[:, used:], started[:, used:]), "degrees not in use are left alone"
    assert torch.equal(k.params[:20], started[:20]), "frozen colours keep their harmonics"


def test_frozen_colours_keep_their_harmonics_too() -> None:
    true, view = shiny_wall(), ReferenceView(CAMERA, OPTIONS)
    field = deepcopy(true)
    field.params[:, COLUMNS["colors"]] += 0.1
    before = deepcopy(field)
    fit_field(field, view, [[seen_from(true, np.eye(4), view)]], MappingConfig(), frozen_colors=60, degree=3)
    for now, then in (
        (field.colors, before.colors),
        (field.attributes["harmonics"].params, before.attributes["harmonics"].params),
    ):
        assert torch.equal(now[:60], then[:60]) and not torch.equal(now[60:], then[60:])


def test_degree_0_is_the_plain_step() -> None:
    view, weights = ReferenceView(CAMERA, OPTIONS), loss_weights(MappingConfig())
    assert isinstance(step_for(view, weights, 0), TorchStep)
    assert isinstance(step_for(view, weights, 1), ViewDependentStep)
