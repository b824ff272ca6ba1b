"""Hold the full colour covariance to its law, to finite differences, to the diagonal it extends and to itself."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from sigmasplat.config import MappingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.color_covariance import MOST_CORRELATED, correlations_of, covariances_of
from sigmasplat.data.field import COLUMNS, GaussianField, Rows
from sigmasplat.data.frame import Frame
from sigmasplat.fit import adam, losses
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.color_covariance import FullCovarianceStep
from sigmasplat.fit.cpu.mapping_step import CompiledImages
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.mapping_step import TorchStep
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.render import render
from sigmasplat.render.backend import make_view
from sigmasplat.render.cpu.covariance_view import CpuCovarianceView
from sigmasplat.render.cpu.view import CpuView
from sigmasplat.render.reference import operators as reference
from sigmasplat.render.reference.covariance_view import CovarianceView
from splat_fields import OPTIONS, assert_same_wide_view, exact_view, maps_of, params_of
from splat_scenes import SMALL, WIDE, Scene, assert_same_vector, scene

WEIGHTS = {"l1": 0.8, "ssim": 0.2, "depth": 1.0, "nll_color": 0.0, "nll_color_full": 1e-2, "nll_depth": 2e-2}
RATES = Rates(torch.linspace(1e-4, 5e-3, 17))


def field_of(s: Scene, seed: int = 0) -> GaussianField:
    """Write a scene as a field, float32, with correlations of every size."""
    field = GaussianField(params_of(s))
    drawn = np.random.default_rng(seed).normal(size=(len(field), 3))
    field.get_or_create("correlations").params = torch.as_tensor(drawn).float()
    return field


def double(field: GaussianField) -> GaussianField:
    """Return a field in float64."""
    attributes = {name: Rows(rows.params.double()) for name, rows in field.attributes.items()}
    return GaussianField(field.params.double(), steps=field.steps, attributes=attributes)


def matrices(six: Tensor) -> Any:
    """Write (rr, gg, bb, rg, rb, gb) [..., 6] as matrices [..., 3, 3], numpy."""
    x = six.detach().numpy()
    return x[..., [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(*x.shape[:-1], 3, 3)


def target_of(camera: Camera, size: tuple[int, int]) -> Target:
    """Draw a frame, with holes in its depth, on planes of `size`."""
    rng, shape = np.random.default_rng(1), (camera.height, camera.width)
    depth = rng.uniform(0.5, 4.0, shape) * (rng.random(shape) < 0.8)
    color = rng.uniform(0, 1, (*shape, 3)).astype(np.float32)
    return Target.of(Frame(0, 0.0, color, depth.astype(np.float32), camera), size)


@pytest.mark.parametrize("size", [0.1, 3.0, 40.0])
def test_covariance_of_a_splat_is_its_cholesky_factor_squared(size: float) -> None:
    rng = np.random.default_rng(int(size))
    a = torch.as_tensor(rng.normal(size=(50, 3)) * size)
    variances = torch.as_tensor(np.exp(rng.uniform(-14, 0, (50, 3))))
    t = MOST_CORRELATED * np.tanh(a.numpy())
    rest, zero, one = np.sqrt(1 - t**2), np.zeros(50), np.ones(50)
    rows = [[one, zero, zero], [t[:, 0], rest[:, 0], zero], [t[:, 1], t[:, 2] * rest[:, 1], rest[:, 2] * rest[:, 1]]]
    L = np.sqrt(variances.numpy())[:, :, None] * np.moveaxis(np.array(rows), -1, 0)
    np.testing.assert_allclose(matrices(covariances_of(variances, a)), L @ L.transpose(0, 2, 1), rtol=1e-12, atol=1e-18)
    in_float32 = torch.as_tensor(matrices(covariances_of(variances.float(), a.float())))
    assert bool((torch.linalg.cholesky_ex(in_float32).info == 0).all()), "positive definite whatever the parameters"


def test_without_correlation_it_is_the_diagonal() -> None:
    variances = torch.rand(9, 3)
    assert torch.equal(covariances_of(variances, torch.zeros(9, 3)), torch.cat([variances, torch.zeros(9, 3)], 1))


@pytest.mark.parametrize("kind", ["random", "overlapping", "needles"])
def test_law_of_total_covariance(backend: Any, kind: str) -> None:
    s = scene(kind, 40)
    field = field_of(s)
    exact, T = double(field), s.T_camera_world
    p = reference.project(exact.means, exact.quats, exact.scales, T, s.camera, OPTIONS)
    every_weight = torch.eye(len(exact), dtype=torch.float64)
    w = reference.blend(*p, exact.opacities, every_weight, None, s.camera, OPTIONS).sums.numpy()
    c = exact.colors.numpy()
    own = matrices(covariances_of(exact.variances, exact.attributes["correlations"].params))
    mean = w @ c
    want = np.einsum("hwn,nij->hwij", w, own + c[:, :, None] * c[:, None]) - mean[..., None] * mean[..., None, :]
    got = backend.render(field, s.camera, T, options=OPTIONS)
    assert got.covariance is not None and np.abs(want[..., 0, 1]).max() > 1e-2
    np.testing.assert_allclose(matrices(got.covariance), want, atol=2e-5)
    assert np.linalg.eigvalsh(matrices(got.covariance).astype(np.float64)).min() > -2e-6


def test_diagonal_of_it_is_the_variance_that_a_field_without_correlations_shows(backend: Any) -> None:
    s = scene("random", 40)
    field = field_of(s)
    with_them = backend.render(field, s.camera, s.T_camera_world, options=OPTIONS)
    without = backend.render(GaussianField(field.params), s.camera, s.T_camera_world, options=OPTIONS)
    assert without.covariance is None and with_them.covariance is not None
    assert torch.equal(with_them.covariance[..., :3], with_them.variance)
    for name in ("color", "depth", "alpha", "variance"):
        torch.testing.assert_close(getattr(with_them, name), getattr(without, name), rtol=1e-5, atol=1e-6)


def test_moving_field_and_camera_together_changes_nothing(backend: Any) -> None:
    s = scene("random", 40)
    field, move = field_of(s), torch.as_tensor(se3.exp(np.array([0.3, -0.2, 0.5, 0.4, -0.6, 0.2])))
    moved = field.moved(move)
    moved.attributes = field.attributes
    T = s.T_camera_world @ torch.as_tensor(se3.inverse(move.numpy()))
    a, b = (backend.render(f, s.camera, pose) for f, pose in ((field, s.T_camera_world), (moved, T)))
    assert a.covariance is not None and b.covariance is not None
    torch.testing.assert_close(a.covariance, b.covariance, rtol=1e-4, atol=2e-5)


def nll_seen(field: GaussianField, s: Scene, backend: str) -> Tensor:
    """Return the full NLL of random colours seen through the renderer."""
    seen = render(field, s.camera, s.T_camera_world, options=OPTIONS, backend=backend)
    colors = torch.as_tensor(np.random.default_rng(3).uniform(size=tuple(seen.color.shape))).to(seen.color)
    assert seen.covariance is not None
    return losses.nll_color_full(seen.color, colors, seen.covariance, s.ref_depth > 0)


@pytest.mark.parametrize("what", ["log_variances", "correlations"])
def test_gradient_through_the_renderer_equals_finite_differences(what: str) -> None:
    """In float64, every number of every splat, with V + εI well away from singular as in a map with some spread."""
    s = scene("random", 12, SMALL)
    field = double(field_of(s))
    field.params[:, COLUMNS["log_variances"]] = torch.as_tensor(np.random.default_rng(2).uniform(-4, -2, (12, 3)))
    leaf = field.params if what == "log_variances" else field.attributes["correlations"].params
    columns = COLUMNS[what] if what in COLUMNS else slice(0, 3)
    leaf.requires_grad_()
    nll_seen(field, s, "reference").backward()
    assert leaf.grad is not None
    got, want = leaf.grad[:, columns], torch.zeros(12, 3, dtype=torch.float64)
    leaf.requires_grad_(False)
    for i in range(12):
        for k in range(3):
            sides = []
            for step in (1e-5, -1e-5):
                leaf[i, columns.start + k] += step
                sides.append(float(nll_seen(field, s, "reference")))
                leaf[i, columns.start + k] -= step
            want[i, k] = (sides[0] - sides[1]) / 2e-5
    assert_same_vector(got, want, 1e-6, what)


def test_gradients_of_both_backends_agree() -> None:
    s = scene("random", 60)
    gradients = []
    for name, field in (("cpu", field_of(s)), ("reference", double(field_of(s)))):
        leaves = (field.params.requires_grad_(), field.attributes["correlations"].params.requires_grad_())
        gradients.append(torch.autograd.grad(nll_seen(field, s, name), leaves))
    for got, want in zip(*gradients, strict=True):
        assert_same_vector(got, want, 2e-3)


def wide_views(s: Scene) -> tuple[CovarianceView, CovarianceView]:
    """Make the view of a scene with correlations on the kernels, and its definition in float64."""
    field = field_of(s)
    exact = CovarianceView(exact_view(s.camera, True), double(field).attributes["correlations"])
    return CpuCovarianceView(CpuView(s.camera, OPTIONS), field.attributes["correlations"]), exact


@pytest.mark.parametrize("kind", ["random", "needles", "off_screen", "huge"])
def test_planes_rows_and_twist_agree(kind: str) -> None:
    s = scene(kind, 60)
    got, want = wide_views(s)
    assert_same_wide_view(got, want, field_of(s), double(field_of(s)), s.T_camera_world.numpy())


def test_twist_of_colour_and_depth_alone() -> None:
    s = scene("random", 60)
    plain, wide = CpuView(s.camera, OPTIONS), wide_views(s)[0]
    twists = []
    for view in (plain, wide):
        view.forward(params_of(s), s.T_camera_world.numpy())
        view.g_sums.zero_()
        view.g_sums[:4] = 1.0
        view.g_sums[4:] = 100.0
        twists.append(torch.as_tensor(view.backward_pose(params_of(s)).copy()))
    assert_same_vector(*reversed(twists), 1e-3, "pose")


def test_it_sees_what_the_view_it_stands_for_sees() -> None:
    s = scene("random", 60)
    plain, wide = CpuView(s.camera, OPTIONS), wide_views(s)[0]
    for view in (plain, wide):
        view.forward(params_of(s), s.T_camera_world.numpy(), s.ref_depth.float())
    torch.testing.assert_close(maps_of(wide)[:7], maps_of(plain)[:7], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(wide.alpha, plain.alpha)
    torch.testing.assert_close(wide.moment, plain.moment)


def test_whole_loss_and_its_gradient() -> None:
    s = scene("random", 60)
    losses_, planes = [], []
    for view, params, fused in zip(wide_views(s), (params_of(s), params_of(s).double()), (True, False), strict=True):
        view.forward(params, s.T_camera_world.numpy())
        step = FullCovarianceStep(view, CompiledImages(view) if fused else TorchStep(view))
        view.g_sums += 3.0  # what was there must go
        losses_.append(step.images(target_of(s.camera, tuple(view.alpha.shape)), WEIGHTS))
        planes.append(view.g_sums[:, : s.camera.height, : s.camera.width].clone())
    assert losses_[0] == pytest.approx(losses_[1], rel=1e-4)
    for plane, (got, want) in enumerate(zip(*planes, strict=True)):
        assert_same_vector(got, want, 1e-2, f"plane {plane}")


@pytest.mark.parametrize("name", ["cpu", "reference"])
def test_mapping_moves_correlations_only_where_it_is_asked_to(name: str) -> None:
    s = scene("random", 60)
    for kind in ("diagonal", "full"):
        field, view = GaussianField(params_of(s)), make_view(name, s.camera, OPTIONS)
        before = field.params.clone()
        target = target_of(s.camera, tuple(view.alpha.shape))
        seen = Keyframe(0, target, se3.inverse(s.T_camera_world.numpy()))
        config = MappingConfig(color_covariance=kind, weight_nll_color=1e-2, lr_pose_translation=1e-3)
        fit_field(field, view, [[seen]] * 3, config)
        assert ("correlations" in field.attributes) == (kind == "full")
        assert not torch.equal(field.params, before) and seen.T_world_camera[0, 3] != -s.T_camera_world[0, 3]
        if kind == "full":
            rows, visible = field.attributes["correlations"], view_sees(s, field)
            assert bool(rows.params[visible].any()) and not rows.params[~visible].any()
            assert float(rows.params.abs().max()) < 3.1 * config.lr_log_variances


def test_view_dependent_colour_is_fitted_under_it_too() -> None:
    """Correlations are used then, in V, but stay as they are."""
    s, fitted = scene("random", 60), []
    config = MappingConfig(color_covariance="full", weight_nll_color=1e-2)
    for correlated in (0.0, 1.0):
        field, view = GaussianField(params_of(s)), make_view("cpu", s.camera, OPTIONS)
        field.get_or_create("correlations").params += correlated
        target = target_of(s.camera, tuple(view.alpha.shape))
        fit_field(field, view, [[Keyframe(0, target, se3.inverse(s.T_camera_world.numpy()))]] * 3, config, degree=1)
        assert bool((field.attributes["correlations"].params == correlated).all())
        assert bool(field.attributes["harmonics"].params.any())
        fitted.append(field.params[:, COLUMNS["log_variances"]])
    assert not torch.equal(*fitted)


def view_sees(s: Scene, field: GaussianField) -> Tensor:
    """Tell which splats of a field are in a scene's view."""
    view = CpuView(s.camera, OPTIONS)
    view.forward(field.params, s.T_camera_world.numpy())
    return view.visible(len(field))


def test_frozen_colours_stay_and_the_others_move() -> None:
    s = scene("random", 60, WIDE)
    field = field_of(s)
    view = CpuCovarianceView(CpuView(s.camera, OPTIONS), field.attributes["correlations"])
    step, before, field.steps = FullCovarianceStep(view, CompiledImages(view)), field.params.clone(), 1
    target = target_of(s.camera, tuple(view.alpha.shape))
    step.forward(field, s.T_camera_world.numpy(), target, WEIGHTS)
    step.images(target, WEIGHTS)
    step.splats(field, RATES, WEIGHTS, 30)
    colors, moved = COLUMNS["colors"], view.visible(60)
    assert torch.equal(field.params[:30, colors], before[:30, colors])
    assert bool((field.params[30:, colors] != before[30:, colors]).any(1)[moved[30:]].all())
    assert torch.equal(field.params[~moved], before[~moved])


def test_it_finds_how_the_channels_of_noise_go_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """A black wall, all of whose V is its own: red and green of the noise go together, blue against both."""
    monkeypatch.setitem(adam.ATTRIBUTE_RATES, "correlations", ("log_variances", 1.0))
    camera, rng = Camera(40, 30, 40.0, 40.0, 19.5, 14.5), np.random.default_rng(4)
    R = np.array([[1.0, 0.8, -0.5], [0.8, 1.0, -0.6], [-0.5, -0.6, 1.0]])
    noise = rng.normal(size=(12, 30, 40, 3)) @ np.linalg.cholesky(0.05**2 * R).T
    wall = GaussianField.from_values(
        torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[5.0, 5.0, 0.01]]), torch.zeros(1, 3), opacities=0.999
    )
    view = make_view("cpu", camera, OPTIONS)
    frames = [Frame(0, 0.0, x.astype(np.float32), np.ones((30, 40), np.float32), camera) for x in noise]
    seen = [Keyframe(0, Target.of(frame, tuple(view.alpha.shape)), np.eye(4)) for frame in frames]
    off = dict.fromkeys(("means", "quats", "log_scales", "opacity_logits", "colors"), 0.0)
    config = replace(MappingConfig(color_covariance="full"), **{f"lr_{k}": v for k, v in off.items()})
    fit_field(wall, view, [[keyframe] for keyframe in seen] * 30, replace(config, lr_log_variances=2e-2))
    r, want = correlations_of(wall.attributes["correlations"].params)[0], torch.tensor([0.8, -0.5, -0.6])
    assert float((r - want).abs().max()) < 0.04
    assert wall.variances[0].sqrt().tolist() == pytest.approx([0.05] * 3, rel=0.2)
