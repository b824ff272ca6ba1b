"""Hold the fused view, raw rows to planes and back, against the reference in float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from sigmasplat.model.camera import Camera
from sigmasplat.model.field import COLUMNS, GaussianField
from splat_fields import OPTIONS, crowd, exact_view, maps_of, params_of, there_and_back
from splat_scenes import KINDS, SMALL, WIDE, Scene, assert_same_vector, scene

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

from sigmasplat.render.cpu.view import CpuView
from sigmasplat.render.reference import operators as reference
from sigmasplat.render.reference.view import reaches

SIZES = (SMALL, WIDE, Camera(1, 1, 20.0, 20.0, 0.0, 0.0), Camera(33, 17, 30.0, 30.0, 15.5, 8.2))


def assert_same_view(s: Scene, params: Tensor, variance: bool) -> None:
    """Compare maps, gradient rows column group by column group, and twist."""
    T = s.T_camera_world.numpy()
    maps, rows, twist = there_and_back(CpuView(s.camera, OPTIONS, variance), params, T)
    want_maps, want_rows, want_twist = there_and_back(exact_view(s.camera, variance), params.double(), T)
    for plane, (got, want) in enumerate(zip(maps, want_maps, strict=True)):
        assert float((got - want).abs().max()) < 2e-4 * max(float(want.abs().max()), 1.0), f"plane {plane}"
        assert float((got - want).norm()) < 2e-5 * float(want.norm()), f"plane {plane}"
    for name, columns in COLUMNS.items():
        if name == "log_variances" and not variance:
            assert torch.count_nonzero(rows[:, columns]) == 0
        else:
            assert_same_vector(rows[:, columns], want_rows[:, columns], what=name)
    assert_same_vector(twist, want_twist, what="twist")


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
@pytest.mark.parametrize("kind", KINDS)
def test_planes_rows_and_twist_agree(kind: str, variance: bool) -> None:
    s = scene(kind, 60)
    assert_same_view(s, params_of(s), variance)


@pytest.mark.parametrize("camera", SIZES, ids=lambda c: f"{c.width}x{c.height}")
def test_any_image_size(camera: Camera) -> None:
    s = scene("huge", 19, camera)
    assert_same_view(s, params_of(s), True)


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8, 9, 16, 17])
def test_any_number_of_splats(n: int) -> None:
    s = scene("huge", 40)
    few = replace(s, **{k: getattr(s, k)[:n] for k in ("means", "quats", "scales", "opacities", "features")})
    assert_same_view(few, params_of(few), True)


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
def test_nothing_to_see_gives_zeros(variance: bool) -> None:
    s = scene("random", 60)
    params, T = params_of(s), s.T_camera_world.numpy()
    away = np.diag([-1.0, 1.0, -1.0, 1.0]) @ T  # turned round: every splat lies behind
    view = CpuView(s.camera, OPTIONS, variance)
    for rows, pose in ((params[:0], T), (params, away)):
        view.forward(params, T)
        assert float(view.alpha.max()) > 0.1
        maps, gradient, twist = there_and_back(view, rows, pose)
        assert all(torch.count_nonzero(x) == 0 for x in (maps, gradient, twist))
        assert not view.visible(len(rows)).any() and len(view.visible(len(rows))) == len(rows)


@pytest.mark.parametrize("kind", [*KINDS, "crowd"])
def test_both_views_see_the_same_splats(kind: str) -> None:
    s = crowd() if kind == "crowd" else scene(kind, 60)
    params, T, n = params_of(s), s.T_camera_world.numpy(), len(s.means)
    view = CpuView(s.camera, OPTIONS)
    view.forward(params, T)
    f = GaussianField(params.double())
    p = reference.project(f.means, f.quats, f.scales, s.T_camera_world.double(), s.camera, OPTIONS)
    seen = reaches(p, f.opacities, s.camera, OPTIONS)
    assert torch.equal(view.visible(n), seen) and seen.sum() > 0


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
@pytest.mark.parametrize("kind", [*KINDS, "crowd"])
def test_a_pose_alone_feels_colour_and_depth(isa: str, kind: str, variance: bool) -> None:
    """Chained tile by tile, to the same twist: gradients on V's planes and on alpha are not its to carry."""
    s = crowd() if kind == "crowd" else scene(kind, 60)
    params, T = params_of(s), s.T_camera_world.numpy()
    view, exact = CpuView(s.camera, OPTIONS, variance), exact_view(s.camera, variance)
    there_and_back(view, params, T)
    got = view.backward_pose(params)
    view.g_sums[4:].zero_()
    view.g_alpha.zero_()
    whole = view.backward(params, torch.empty_like(params))
    assert_same_vector(torch.as_tensor(got), torch.as_tensor(whole), 1e-5, f"{isa} {kind} against every row")
    if kind != "crowd":
        exact.forward(params.double(), T)
        exact.g_sums.copy_(view.g_sums[:, : s.camera.height, : s.camera.width])
        assert_same_vector(torch.as_tensor(got), torch.as_tensor(exact.backward_pose(params)), what=f"{isa} {kind}")


@pytest.mark.parametrize("kind", KINDS)
def test_visible_are_at_least_those_that_feel_a_gradient(kind: str) -> None:
    s = scene(kind, 60)
    view = CpuView(s.camera, OPTIONS)
    _, rows, _ = there_and_back(view, params_of(s), s.T_camera_world)
    visible, felt = view.visible(60), (rows != 0).any(1)
    assert felt.any() and not (felt & ~visible).any()
    depth = (s.means @ s.T_camera_world[:3, :3].T + s.T_camera_world[:3, 3])[:, 2]
    assert not visible[depth <= s.options.near_m].any()


def test_one_view_serves_fields_that_grow_and_shrink() -> None:
    s = crowd()
    params, view = params_of(s), CpuView(s.camera, OPTIONS)
    T = s.T_camera_world.numpy()
    for n in (50, 2003, 1, 700, 0, 512, 513, 1300):
        kept = there_and_back(view, params[:n].contiguous(), T)
        fresh = there_and_back(CpuView(s.camera, OPTIONS), params[:n].contiguous(), T)
        assert all(torch.equal(a, b) for a, b in zip(kept, fresh, strict=True)), n


def test_two_views_do_not_disturb_each_other() -> None:
    s = crowd()
    params, T = params_of(s), s.T_camera_world.numpy()
    alone = there_and_back(CpuView(s.camera, OPTIONS), params, T)
    first, second = CpuView(s.camera, OPTIONS), CpuView(WIDE, OPTIONS, variance=False)
    there_and_back(first, params, T)
    there_and_back(second, params[:300].contiguous(), T)
    rows = torch.empty_like(params)
    twist = first.backward(params, rows)
    assert torch.equal(rows, alone[1]) and np.array_equal(twist, alone[2].numpy())
    assert torch.equal(maps_of(first), alone[0])


@pytest.mark.parametrize("kind", KINDS)
def test_layers_say_which_splats_make_a_pixel(kind: str) -> None:
    """Weights and median depth as the definition has them; the splats too, but where two are as good."""
    s = scene(kind, 60)
    params, T = params_of(s), s.T_camera_world.numpy()
    views = CpuView(s.camera, OPTIONS), exact_view(s.camera, True)
    for view, rows in zip(views, (params, params.double()), strict=True):
        view.forward(rows, T, layers=True)
    h, w = s.camera.height, s.camera.width
    got, want = ([plane[:h, :w] for plane in view.layers] for view in views)
    assert (want[0] >= 0).any(), "the scene has opaque pixels"
    assert (got[0] == want[0]).float().mean() > 0.99 and (got[2] == want[2]).float().mean() > 0.99
    same = got[0] == want[0]
    assert torch.allclose(got[4][same].double(), want[4][same].double(), atol=1e-5)
    assert (got[4] > 0).equal(got[0] >= 0)
    assert torch.allclose(got[3].double(), want[3].double(), atol=1e-5)
