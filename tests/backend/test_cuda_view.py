"""Hold the CUDA view, raw rows to planes and back, against the reference in float64, on the emulated kernels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from emulated_cuda import Emulator
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import COLUMNS
from sigmasplat.render.cuda.view import CudaView
from sigmasplat.render.view import View
from splat_fields import OPTIONS, crowd, exact_view, params_of, plane_gradients, there_and_back
from splat_scenes import KINDS, SMALL, WIDE, Scene, assert_same_vector, scene

SIZES = (SMALL, WIDE, Camera(1, 1, 20.0, 20.0, 0.0, 0.0), Camera(33, 17, 30.0, 30.0, 15.5, 8.2))
CPU = torch.device("cpu")


pytestmark = pytest.mark.usefixtures("on_the_cpu")


def view_of(s: Scene, variance: bool = True) -> CudaView:
    return CudaView(s.camera, OPTIONS, variance, CPU)


def assert_same_view(s: Scene, params: Tensor, variance: bool) -> None:
    """Compare maps, gradient rows column group by column group, and twist."""
    T = s.T_camera_world.numpy()
    maps, rows, twist = there_and_back(view_of(s, variance), params, T)
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


@pytest.mark.parametrize("n", [1, 2, 9, 17])
def test_any_number_of_splats(n: int) -> None:
    s = scene("huge", 40)
    few = replace(s, **{k: getattr(s, k)[:n] for k in ("means", "quats", "scales", "opacities", "features")})
    assert_same_view(few, params_of(few), True)


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
def test_nothing_to_see_gives_zeros(variance: bool) -> None:
    s = scene("random", 60)
    params, T = params_of(s), s.T_camera_world.numpy()
    away = np.diag([-1.0, 1.0, -1.0, 1.0]) @ T  # turned round: every splat lies behind
    view = view_of(s, variance)
    for rows, pose in ((params[:0], T), (params, away)):
        view.forward(params, T)
        assert float(view.alpha.max()) > 0.1
        maps, gradient, twist = there_and_back(view, rows, pose)
        assert all(torch.count_nonzero(x) == 0 for x in (maps, gradient, twist))
        assert not view.visible(len(rows)).any() and len(view.visible(len(rows))) == len(rows)
        assert not view.backward_pose(rows).any()


@pytest.mark.parametrize("kind", KINDS)
def test_both_views_see_the_same_splats(kind: str) -> None:
    s = scene(kind, 60)
    views: list[View] = [view_of(s), exact_view(s.camera, True)]
    for view, rows in zip(views, (params_of(s), params_of(s).double()), strict=True):
        view.forward(rows, s.T_camera_world.numpy())
    assert torch.equal(views[0].visible(60), views[1].visible(60)) and views[0].visible(60).any()


def everything(view: View, s: Scene, dtype: torch.dtype) -> list[Tensor]:
    """Run forward with moment and layers and back: every map that is an output, rows, pull, twist."""
    params, T, (h, w) = params_of(s).to(dtype), s.T_camera_world.numpy(), (s.camera.height, s.camera.width)
    view.forward(params, T, s.ref_depth.to(dtype), layers=True)
    g_sums, g_alpha = plane_gradients(s.camera, len(view.sums))
    g_depths = plane_gradients(s.camera, 2, seed=9)[0]
    for plane, value in zip((view.g_sums, view.g_alpha, view.g_moment), (g_sums, g_alpha, g_depths[0]), strict=True):
        plane.copy_(value)
    view.g_median_depth.copy_(g_depths[1])
    rows, pull = torch.full_like(params, torch.nan), torch.full_like(params[:, 0], torch.nan)
    twist = torch.as_tensor(view.backward(params, rows, pull).copy())
    maps = [plane[:h, :w].clone() for plane in (view.moment, *view.layers)]
    return [*maps, rows, pull, twist]


@pytest.mark.parametrize("kind", KINDS)
def test_moment_layers_and_pull_agree(kind: str) -> None:
    s = scene(kind, 60)
    exact = exact_view(s.camera, True)
    for name in ("moment", "g_moment", "g_median_depth"):
        setattr(exact, name, getattr(exact, name).double())
    got, want = everything(view_of(s), s, torch.float32), everything(exact, s, torch.float64)
    names = ("moment", "median_id", "median_weight", "dominant_id", "dominant_weight", "median_depth")
    for name, a, b in zip(names, got, want, strict=False):
        if a.dtype == torch.int32:
            assert (a == b).float().mean() > 0.99, name
        else:
            torch.testing.assert_close(a.double(), b.double(), rtol=1e-4, atol=2e-5, msg=name)
    for name, a, b in zip(("rows", "pull", "twist"), got[6:], want[6:], strict=True):
        assert_same_vector(a, b, what=f"{kind} {name}")


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_pose_alone_feels_colour_and_depth(kind: str, variance: bool) -> None:
    """Gradients on V's planes and on alpha are not its to carry."""
    s = scene(kind, 60)
    params, T = params_of(s), s.T_camera_world.numpy()
    view, exact = view_of(s, variance), exact_view(s.camera, variance)
    there_and_back(view, params, T)
    got = view.backward_pose(params)
    exact.forward(params.double(), T)
    exact.g_sums.copy_(view.g_sums)
    assert_same_vector(torch.as_tensor(got), torch.as_tensor(exact.backward_pose(params)), what=kind)


@pytest.mark.parametrize("order", [1, 2, 3], ids=["warp by warp", "backwards", "shuffled"])
def test_the_order_of_threads_between_barriers_means_nothing(on_the_cpu: Emulator, order: int) -> None:
    s = scene("overlapping", 60)
    want = everything(view_of(s), s, torch.float32)
    on_the_cpu.order = order
    got = everything(view_of(s), s, torch.float32)
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))


def test_lists_cut_short_change_no_bit(on_the_cpu: Emulator) -> None:
    """Where there are more pairs than expected, tiles go through all splats, and are listed anew for the way back."""
    s = scene("random", 60)
    want = everything(view_of(s), s, torch.float32)
    cut = view_of(s)
    cut.raster.capacity = 7
    on_the_cpu.launches.clear()
    got = everything(cut, s, torch.float32)
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))
    assert on_the_cpu.launches.count("list_pairs_short") == 2 and (cut.raster.capacity or 0) > 60
    on_the_cpu.launches.clear()
    again = everything(cut, s, torch.float32)
    assert all(torch.equal(a, b) for a, b in zip(again, want, strict=True))
    assert on_the_cpu.launches.count("list_pairs_short") == 1


def test_a_view_serves_fields_that_grow_and_shrink() -> None:
    s = crowd()
    params, view, T = params_of(s), view_of(s), s.T_camera_world.numpy()
    for n in (50, 700, 1, 0, 512):
        kept = there_and_back(view, params[:n].contiguous(), T)
        fresh = there_and_back(view_of(s), params[:n].contiguous(), T)
        assert all(torch.equal(a, b) for a, b in zip(kept, fresh, strict=True)), n


def test_more_tiles_than_short_numbers_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    s = scene("random", 60)
    want = there_and_back(view_of(s), params_of(s), s.T_camera_world)
    wide = view_of(s)
    plain = torch.iinfo

    class Few:
        max = 3

    monkeypatch.setattr(torch, "iinfo", lambda kind: Few if kind == torch.int16 else plain(kind))
    got = there_and_back(wide, params_of(s), s.T_camera_world)
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))


@pytest.mark.parametrize("kind", ["random", "needles", "walled"])
def test_a_crowd_agrees(kind: str) -> None:
    """Many batches a tile; walled: opaque splats in front, so that tiles end early and records behind are zero.

    Among so many some pairs are on the other side of alpha_min in single precision.
    """
    s = crowd(kind="random" if kind == "walled" else kind)
    params, T = params_of(s), s.T_camera_world.numpy()
    if kind == "walled":
        nearest = (s.means @ s.T_camera_world[2, :3]).argsort()[:12]
        params[nearest, 7:10], params[nearest, 10] = torch.tensor([0.7, 0.4, 0.0]), 6.0
    maps, rows, twist = there_and_back(view_of(s), params, T)
    want_maps, want_rows, want_twist = there_and_back(exact_view(s.camera, True), params.double(), T)
    assert float((maps - want_maps).abs().max()) < 2.0 / 255 and float((maps - want_maps).abs().mean()) < 5e-5
    for name, columns in COLUMNS.items():
        assert_same_vector(rows[:, columns], want_rows[:, columns], 4e-3, what=name)
    assert_same_vector(twist, want_twist, 1e-3, what="twist")
