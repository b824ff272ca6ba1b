"""Depth along the ray: the kernels follow the definition, which finds where a splat is densest on a ray."""

from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from paper_settings import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.render import reference, render
from sigmasplat.render.backend import make_view
from sigmasplat.render.cpu import CpuView
from sigmasplat.uncertainty.predictive import blend_values
from splat_fields import crowd, exact_view, params_of, plane_gradients
from splat_scenes import KINDS, Scene, assert_same_vector, scene

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

RAY = RenderConfig(depth="ray")


def carried(view: Any, params: Tensor, s: Scene, maps: bool) -> dict[str, Tensor]:
    """Render, with U and median depth if `maps`; draw gradients on every plane; return all results."""
    h, w = s.camera.height, s.camera.width
    view.forward(params, s.T_camera_world.numpy(), s.ref_depth.to(params) if maps else None, layers=maps)
    drawn, extra = plane_gradients(s.camera, len(view.sums)), plane_gradients(s.camera, 2, seed=4)[0]
    for plane in (view.g_sums, view.g_alpha, view.g_moment, view.g_median_depth):
        plane.zero_()
    view.g_sums[:, :h, :w], view.g_alpha[:h, :w] = drawn
    view.g_moment[:h, :w], view.g_median_depth[:h, :w] = extra[0], extra[1]
    rows, pull = torch.full_like(params, torch.nan), torch.full_like(params[:, 0], torch.nan)
    found = {"twist": torch.as_tensor(view.backward(params, rows, pull).copy()), "pull": pull}
    found |= {name: rows[:, columns] for name, columns in COLUMNS.items() if len(view.sums) == 7 or "var" not in name}
    view.forward(params, s.T_camera_world.numpy())
    view.g_alpha.zero_()
    found["pose"] = torch.as_tensor(view.backward_pose(params).copy())
    view.forward(params, s.T_camera_world.numpy(), s.ref_depth.to(params) if maps else None, layers=maps)
    planes = [*view.sums, view.alpha, *([view.moment, view.layers.median_depth] if maps else [])]
    return found | {"planes": torch.stack(planes)[:, :h, :w]}


@pytest.mark.parametrize("maps", [False, True], ids=["sums", "all maps"])
@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
@pytest.mark.parametrize("kind", KINDS)
def test_planes_and_gradients_follow_the_definition(kind: str, variance: bool, maps: bool, kernels: str) -> None:
    s = scene(kind, 60)
    params = params_of(s)
    got = carried(make_view(kernels, s.camera, RAY, variance), params, s, maps)
    want = carried(exact_view(s.camera, variance, RAY), params.double(), s, maps)
    for name, value in want.items():
        assert_same_vector(got[name], value, 1e-3 if name == "planes" else 2e-4, name)


MANY = 700
"""Splats of a crowd: the definition takes as long for each."""


@cache
def exact_crowd() -> dict[str, Tensor]:
    """Return what the definition, which is slow, carries for a crowd."""
    s = crowd(count=MANY)
    return carried(exact_view(s.camera, True, RAY), params_of(s).double(), s, True)


def test_every_instruction_set_follows_it(isa: str) -> None:
    s = crowd(count=MANY)
    got = carried(CpuView(s.camera, RAY), params_of(s), s, True)
    for name, value in exact_crowd().items():
        assert_same_vector(got[name], value, 2e-3, f"{isa} {name}")


def test_slopes_are_those_of_the_densest_point_along_the_ray() -> None:
    """For a splat much wider than a pixel: along the ray, its density is largest at z + slopes · (pixel − mean)."""
    camera, mean = Camera(200, 150, 180.0, 180.0, 99.5, 74.5), torch.tensor([[0.1, -0.05, 2.0]]).double()
    quat, scale = torch.tensor([[0.9, 0.3, -0.2, 0.1]]).double(), torch.tensor([[0.08, 0.06, 0.004]]).double()
    T = torch.eye(4, dtype=torch.float64)
    p = reference.project(mean, quat, scale, T, camera, RAY)
    slopes = reference.depth_slopes(mean, quat, scale, T, camera, RAY)[0]
    axes = reference.rotations(quat)[0] * scale[0]
    precision = torch.linalg.inv(axes @ axes.T)
    for pixel in (p.means2d[0] + torch.tensor([2.0, 1.0]), p.means2d[0] + torch.tensor([-1.0, 2.5])):
        ray = torch.stack([(pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, torch.tensor(1.0)])
        densest = float((ray @ precision @ mean[0]) / (ray @ precision @ ray))
        linear = float(p.z[0] + slopes @ (pixel - p.means2d[0]))
        assert linear == pytest.approx(densest, abs=0.1 * abs(densest - 2.0)) and abs(densest - 2.0) > 5e-3


def test_a_render_and_a_view_have_the_same_depth(kernels: str) -> None:
    s = scene("random", 60)
    field, view, T = GaussianField(params_of(s)), make_view(kernels, s.camera, RAY), s.T_camera_world.numpy()
    view.forward(field.params, T, layers=True)
    crop = slice(s.camera.height), slice(s.camera.width)
    seen, center = (render(field, s.camera, T, None, options, kernels) for options in (RAY, None))
    assert_same_vector(seen.depth, view.sums[3][crop], 1e-5, "depth")
    assert_same_vector(seen.median_depth, view.layers.median_depth[crop], 1e-5, "median depth")
    blended = blend_values(field, s.camera, T, torch.zeros(60, 0), RAY, kernels)
    assert_same_vector(blended.depth, seen.depth, 1e-5, "depth beside values")
    assert float((seen.depth - center.depth).abs().max()) > 1e-2
    assert torch.equal(seen.alpha, center.alpha) and torch.equal(seen.color, center.color)
    assert render(GaussianField.empty(), s.camera, T, None, RAY, kernels).depth.shape == seen.depth.shape
