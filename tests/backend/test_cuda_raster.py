"""What is true of CUDA's views alone, emulated: the order of threads, lists of pairs cut short, many tiles."""

import pytest
import torch

from emulated_cuda import Emulator
from sigmasplat.plugins.cuda.view import CudaView
from splat_fields import CPU, OPTIONS, params_of, there_and_back
from splat_scenes import Scene, scene
from test_view import everything

pytestmark = pytest.mark.usefixtures("on_the_cpu")


def view_of(s: Scene) -> CudaView:
    return CudaView(s.camera, OPTIONS, True, CPU)


@pytest.mark.parametrize("order", [1, 2, 3], ids=["warp by warp", "backwards", "shuffled"])
def test_the_order_of_threads_between_barriers_means_nothing(on_the_cpu: Emulator, order: int) -> None:
    s = scene("overlapping", 60)
    want = everything(view_of(s), s, torch.float32)
    on_the_cpu.order = order
    got = everything(view_of(s), s, torch.float32)
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))


def test_lists_cut_short_change_no_bit() -> None:
    """Where there are more pairs than expected, tiles go through all splats, and are listed anew for the way back."""
    s = scene("random", 60)
    want = everything(view_of(s), s, torch.float32)
    cut = view_of(s)
    cut.raster.capacity = 7
    for _ in range(2):  # the second time there is room
        got = everything(cut, s, torch.float32)
        assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))
        assert (cut.raster.capacity or 0) > 60


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
