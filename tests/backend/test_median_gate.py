"""The median gate of rendered depth: its laws, its gradient with the median held fixed, and kernels that follow it."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from sigmasplat.config import Config, RenderConfig
from sigmasplat.config.presets import preset
from sigmasplat.config.text import override
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.errors import BackendError, ConfigError
from sigmasplat.render import render
from sigmasplat.render.backend import options_on
from sigmasplat.render.blended_values import blend_values
from sigmasplat.render.cpu.view import CpuView
from sigmasplat.render.cuda.view import CudaView
from sigmasplat.render.reference import operators as reference
from splat_fields import CPU, crowd, exact_view, params_of, plane_gradients
from splat_scenes import KINDS, SMALL, WIDE, Scene, assert_same_vector, make, scene

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

DEPTHS = ("center", "ray")
GATE_M = 0.4


def gated(depth: Any = "center", gate_m: float = GATE_M) -> RenderConfig:
    """Return options with a median gate; the splats of the test scenes are metres apart."""
    return RenderConfig(depth=depth, depth_gate_m=gate_m)


def carried(view: Any, params: Tensor, s: Scene, maps: bool) -> dict[str, Tensor]:
    """Render, with U and median depth if `maps`; draw gradients on every plane; return all results."""
    h, w = s.camera.height, s.camera.width
    T, about = s.T_camera_world.numpy(), s.ref_depth.to(params) if maps else None
    drawn, extra = plane_gradients(s.camera, len(view.sums)), plane_gradients(s.camera, 2, seed=4)[0]
    for plane in (view.g_sums, view.g_alpha, view.g_moment, view.g_median_depth):
        plane.zero_()
    view.forward(params, T, about, layers=maps)
    planes = [*view.sums, view.alpha, *([view.moment, view.layers.median_depth] if maps else [])]
    found = {"planes": torch.stack(planes)[:, :h, :w].clone()}
    view.g_sums[:, :h, :w], view.g_alpha[:h, :w] = drawn
    view.g_sums[3] *= 3.0  # so that errors of depth alone are seen
    view.g_moment[:h, :w], view.g_median_depth[:h, :w] = extra[0], extra[1]
    rows, pull = torch.full_like(params, torch.nan), torch.full_like(params[:, 0], torch.nan)
    found |= {"twist": torch.as_tensor(view.backward(params, rows, pull).copy()), "pull": pull}
    found |= {name: rows[:, columns] for name, columns in COLUMNS.items() if len(view.sums) == 7 or "var" not in name}
    view.forward(params, T)
    view.g_alpha.zero_()
    return found | {"pose": torch.as_tensor(view.backward_pose(params).copy())}


@pytest.mark.parametrize("maps", [False, True], ids=["sums", "all maps"])
@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("kind", KINDS)
def test_planes_and_gradients_follow_the_definition(kind: str, depth: str, variance: bool, maps: bool) -> None:
    s = scene(kind, 60)
    options, params = gated(depth), params_of(s)
    got = carried(CpuView(s.camera, options, variance), params, s, maps)
    want = carried(exact_view(s.camera, variance, options), params.double(), s, maps)
    for name, value in want.items():
        assert_same_vector(got[name], value, 1e-3 if name == "planes" else 2e-4, name)


@pytest.mark.parametrize("depth", DEPTHS)
def test_every_instruction_set_follows_it(isa: str, depth: str) -> None:
    s, options = scene("random", 60), gated(depth)
    params = params_of(s)
    got = carried(CpuView(s.camera, options), params, s, True)
    want = carried(exact_view(s.camera, True, options), params.double(), s, True)
    for name, value in want.items():
        assert_same_vector(got[name], value, 1e-3 if name == "planes" else 2e-4, f"{isa} {name}")


class Definition:
    """The gated depth written out for a small scene in float64, with the median depths held fixed."""

    def __init__(self, s: Scene, options: RenderConfig) -> None:
        self.s, self.options = s, options
        weights, depths, order = self._splats(*self.leaves())
        light = 1.0 - torch.cumsum(weights[..., order], -1)
        ahead = torch.cat([torch.ones_like(light[..., :1]), light[..., :-1]], -1)
        at = ((ahead >= 0.5) & (light < 0.5)).int()
        first = order[at.argmax(-1)]
        self.median = depths.gather(-1, first[..., None])
        self.behind = torch.zeros_like(weights, dtype=torch.bool)
        self.behind[..., order] = ahead < 0.5

    def leaves(self) -> list[Tensor]:
        """Copy what the depth depends on."""
        return [x.clone() for x in (self.s.means, self.s.quats, self.s.scales, self.s.opacities)]

    def _splats(self, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        s, n = self.s, len(means)
        p = reference.project(means, quats, scales, s.T_camera_world, s.camera, self.options)
        weights = reference.blend(*p, opacities, torch.eye(n).to(means), None, s.camera, self.options).sums
        depths = p.z.expand_as(weights)
        if self.options.depth == "ray":
            slopes = reference.depth_slopes(means, quats, scales, s.T_camera_world, s.camera, self.options)
            v, u = torch.meshgrid(torch.arange(s.camera.height), torch.arange(s.camera.width), indexing="ij")
            away = torch.stack([u, v], -1)[:, :, None] - p.means2d
            depths = p.z + (slopes * away).sum(-1)
        return weights, depths, torch.sort(p.z.detach(), stable=True).indices

    def __call__(self, *leaves: Tensor) -> Tensor:
        """Return the gated depth [H, W]."""
        weights, depths, _ = self._splats(*leaves)
        beta = torch.exp(-(((depths - self.median) / self.options.depth_gate_m) ** 2))
        pulled = beta * depths + (1.0 - beta) * self.median
        return (weights * torch.where(self.behind & (depths > self.median), pulled, depths)).sum(-1)


@pytest.mark.parametrize("depth", DEPTHS)
def test_its_gradient_is_that_of_finite_differences_with_the_median_held_fixed(depth: str) -> None:
    s = scene("overlapping", 9, SMALL)
    options, field = gated(depth, 0.1), s.requiring_grad()
    definition, on_pixels = Definition(s, options), plane_gradients(s.camera, 1)[0][0].double()
    p = reference.project(field.means, field.quats, field.scales, s.T_camera_world, s.camera, options)
    slopes = None
    if depth == "ray":
        slopes = reference.depth_slopes(field.means, field.quats, field.scales, s.T_camera_world, s.camera, options)
    found = reference.blend_gated_depth(*p, field.opacities, s.camera, options, slopes)
    assert float((found.detach() - definition(*definition.leaves())).abs().max()) < 1e-12
    leaves, step = (field.means, field.quats, field.scales, field.opacities), 1e-6
    gradients = torch.autograd.grad((found * on_pixels).sum(), leaves)
    for k, gradient in enumerate(gradients):
        differences = torch.zeros_like(gradient)
        for i in range(gradient.numel()):
            values = []
            for sign in (1.0, -1.0):
                moved = definition.leaves()
                moved[k].view(-1)[i] += sign * step
                values.append(float((definition(*moved) * on_pixels).sum()))
            differences.view(-1)[i] = (values[0] - values[1]) / (2 * step)
        assert_same_vector(gradient, differences, 1e-5, ("means", "quats", "scales", "opacities")[k])


def rows_on_axis(depths_m: list[float], opacity: float) -> Tensor:
    """Make wide, thin splats on the optical axis at these depths, of one size in the image, rows [N, 17]."""
    n = len(depths_m)
    means = torch.tensor([[0.0, 0.0, z] for z in depths_m])
    scales = means[:, 2:] * torch.tensor([2.0, 2.0, 0.01])
    return GaussianField.from_values(
        means, scales, torch.rand(n, 3), opacities=torch.full((n,), opacity)
    ).params.float()


def depth_of(rows: Tensor, options: RenderConfig, backend: str) -> Tensor:
    """Render the depth [H, W] of rows from the origin."""
    return render(GaussianField(rows), SMALL, torch.eye(4), None, options, backend).depth.detach()


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_splat_far_behind_a_surface_does_not_move_the_depth(backend: str, depth: str) -> None:
    near, far = rows_on_axis([1.0, 3.0], 0.8), rows_on_axis([1.0, 9.0], 0.8)
    assert float((depth_of(near, gated(depth), backend) - depth_of(far, gated(depth), backend)).abs().max()) < 1e-5
    without = RenderConfig(depth=depth)  # type: ignore[arg-type]
    assert float((depth_of(near, without, backend) - depth_of(far, without, backend)).abs().max()) > 0.5


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_splats_of_one_depth_and_splats_in_front_of_the_median_keep_their_depth(backend: str, depth: str) -> None:
    for rows in (rows_on_axis([1.0, 1.0, 1.0], 0.7), rows_on_axis([1.0, 1.5, 3.0], 0.2)):
        without = RenderConfig(depth=depth)  # type: ignore[arg-type]
        torch.testing.assert_close(depth_of(rows, gated(depth), backend), depth_of(rows, without, backend))


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_very_wide_gate_changes_nothing_and_a_very_narrow_one_gives_the_median(backend: str, depth: str) -> None:
    s = scene("random", 60)
    field, T = GaussianField(params_of(s)), s.T_camera_world
    center = replace(gated(depth), depth_gate_m=0.0)
    without = render(field, s.camera, T, None, center, backend)
    wide = render(field, s.camera, T, None, gated(depth, 1e6), backend)
    torch.testing.assert_close(wide.depth, without.depth)
    narrow = render(field, s.camera, T, None, gated(depth, 1e-6), backend)
    assert float((narrow.depth - without.depth).abs().max()) > 0.1
    assert bool((narrow.depth <= without.depth + 1e-5).all())
    two = rows_on_axis([1.0, 3.0], 0.8)
    seen = render(GaussianField(two), SMALL, torch.eye(4), None, gated(depth, 1e-6), backend)
    torch.testing.assert_close(seen.depth, seen.alpha * seen.median_depth)


@pytest.mark.parametrize("depth", DEPTHS)
def test_only_the_blended_depth_changes(depth: str) -> None:
    s = crowd()
    params, T = params_of(s), s.T_camera_world.numpy()
    with_gate, without = (CpuView(s.camera, o) for o in (gated(depth), gated(depth, 0.0)))
    for view in (with_gate, without):
        view.forward(params, T, s.ref_depth.float(), layers=True)
    crop = slice(s.camera.height), slice(s.camera.width)
    for plane in (0, 1, 2, 4, 5, 6):
        assert torch.equal(with_gate.sums[plane][crop], without.sums[plane][crop])
    assert torch.equal(with_gate.alpha[crop], without.alpha[crop])
    assert torch.equal(with_gate.moment[crop], without.moment[crop])
    for got, want in zip(with_gate.layers, without.layers, strict=True):
        assert torch.equal(got[crop], want[crop])
    assert not torch.equal(with_gate.sums[3][crop], without.sums[3][crop])


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_render_has_the_depth_and_the_gradient_of_a_view(backend: str, depth: str) -> None:
    s = make("random", 60, WIDE, 3)
    view, T = CpuView(s.camera, gated(depth)), s.T_camera_world.float().requires_grad_()
    field = GaussianField(params_of(s).requires_grad_())
    seen = render(field, s.camera, T, None, gated(depth), backend)
    view.forward(field.params.detach(), T.detach().double().numpy())
    crop = slice(s.camera.height), slice(s.camera.width)
    assert_same_vector(seen.depth, view.sums[3][crop], 1e-5, "depth")
    blended = blend_values(field, s.camera, T.detach().numpy(), torch.zeros(60, 0), gated(depth), backend)
    assert_same_vector(blended.depth, seen.depth, 1e-5, "depth beside values")
    on_sums, on_alpha = plane_gradients(s.camera, 7)
    rows = torch.empty_like(field.params)
    view.g_sums[:4][(slice(None), *crop)], view.g_alpha[crop] = on_sums[:4], on_alpha
    view.backward(field.params.detach(), rows)
    loss = (seen.color * on_sums[:3].permute(1, 2, 0)).sum() + (seen.depth * on_sums[3]).sum()
    on_rows, on_pose = torch.autograd.grad(loss + (seen.alpha * on_alpha).sum(), (field.params, T))
    assert_same_vector(on_rows, rows, 1e-3, "rows")
    assert bool(torch.isfinite(on_pose).all()) and float(on_pose.norm()) > 0
    assert (
        render(GaussianField.empty(), s.camera, T.detach(), None, gated(depth), backend).depth.shape == seen.depth.shape
    )


def test_what_has_no_gate_refuses_it_and_bad_values_are_refused() -> None:
    with pytest.raises(BackendError, match=r"render\.depth_gate_m=0"):
        CudaView(WIDE, gated(), True, CPU)
    with pytest.raises(BackendError, match=r"render\.depth_gate_m=0"):
        options_on("cuda", gated())
    assert options_on("cpu", gated("ray")) == gated("ray")
    settings: Config = preset("varsplat-fast").changed(mapping={"color_covariance": "full"})
    with pytest.raises(ConfigError, match=r"render\.depth_gate_m=0"):
        replace(settings, render=gated()).checked()
    for bad in (-0.1, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match=r"render\.depth_gate_m"):
            RenderConfig(depth_gate_m=bad)
    with pytest.raises(ConfigError, match=r"render\.depth_gate_m"):
        override(preset("sigma"), {"render.depth_gate_m": "-0.1"})
