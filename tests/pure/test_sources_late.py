"""The synthetic room as seen by a sensor that reads depth late and rows one after another."""

import numpy as np
import pytest

from sigmasplat.data import se3
from sigmasplat.data.readout import Readout, SensorTimes
from sigmasplat.errors import SourceError
from sigmasplat.fit.align import align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import gray_of
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from sigmasplat.plugins.sources.room.render import build_scene, render_scene

FPS, FRAME = 30.0, 4
SIZE = {"frames": 200, "width": 80, "height": 60, "exposure_change": False}


def test_each_row_is_that_of_a_camera_at_its_time() -> None:
    late = SyntheticRoom(**SIZE, late=0.02, rows=0.05, depth_rows=-0.04)
    path, seen = late.truth().T_world_camera, late.frame(FRAME)
    np.testing.assert_array_equal(path, SyntheticRoom(**SIZE).truth().T_world_camera)
    for row in (0, 20, 29, 59):
        share = (row + 0.5) / 60 - 0.5
        for after_s, is_depth in ((0.05 * share, False), (0.02 - 0.04 * share, True)):
            when = FRAME + FPS * after_s
            k = int(np.floor(when))
            T = se3.exp((when - k) * se3.log(path[k + 1] @ se3.inverse(path[k]))) @ path[k]
            color, depth_m = render_scene(build_scene(1, 0), late.camera, T)
            if is_depth:
                np.testing.assert_allclose(seen.depth_m[row], depth_m[row], atol=1e-4)
            else:  # at edges, whether four rays are cast depends on the rows beside
                apart = np.abs(seen.color[row] - color[row].clip(0, 1)).max(-1)
                assert np.quantile(apart, 0.75) < 0.003 and apart.mean() < 0.03


def test_one_pose_for_all_rows_gives_the_image_of_that_pose() -> None:
    room = SyntheticRoom(**SIZE)
    T = room.truth().T_world_camera[FRAME]
    for one, other in zip(
        render_scene(build_scene(1, 0), room.camera, T),
        render_scene(build_scene(1, 0), room.camera, np.repeat(T[None], 60, 0)), strict=True,
    ):  # fmt: skip
        np.testing.assert_allclose(one, other, atol=1e-5)
    plain, none = room.frame(FRAME), SyntheticRoom(**SIZE, late=0.0, rows=0.0, depth_rows=0.0).frame(FRAME)
    assert plain.color.tobytes() == none.color.tobytes() and plain.depth_m.tobytes() == none.depth_m.tobytes()


def test_late_depth_is_that_of_a_later_frame_and_colour_stays() -> None:
    plain, late = SyntheticRoom(**SIZE), SyntheticRoom(**SIZE, late=1 / FPS)
    np.testing.assert_allclose(late.frame(FRAME).depth_m, plain.frame(FRAME + 1).depth_m, atol=1e-4)
    assert late.frame(FRAME).color.tobytes() == plain.frame(FRAME).color.tobytes()
    early = SyntheticRoom(**SIZE, late=-1 / FPS)
    np.testing.assert_allclose(early.frame(FRAME).depth_m, plain.frame(FRAME - 1).depth_m, atol=1e-4)
    np.testing.assert_array_equal(late.exact_depth_of(FRAME), plain.exact_depth_of(FRAME))


def test_the_true_times_explain_the_images() -> None:
    """Alignment to an image of a camera at rest finds the true motion only if it knows the times."""
    times = SensorTimes(0.03, 0.04, 0.05, std_s=(1e-3, 1e-3, 1e-3))
    rooms = SyntheticRoom(**SIZE), SyntheticRoom(**SIZE, late=0.03, depth_rows=0.04, rows=0.05)
    reference, live = (
        Pyramid.of(gray_of(f.color), f.depth_m, f.camera) for f in (rooms[0].frame(FRAME - 2), rooms[1].frame(FRAME))
    )
    T = rooms[0].truth().T_world_camera
    rate = FPS / 2 * se3.log(se3.inverse(T[FRAME - 1]) @ T[FRAME + 1])
    motion = se3.inverse(T[FRAME]) @ T[FRAME - 2]
    errors = [
        np.abs(se3.log(align(reference, live.read(late), motion).T_live_reference @ se3.inverse(motion))).max()
        for late in (None, Readout(rate, 0.0, times))
    ]
    assert errors[0] > 0.004 and errors[1] < 0.25 * errors[0]


def test_the_ends_of_the_path_go_on() -> None:
    for frames in (1, 2, 5):
        room = SyntheticRoom(frames=frames, width=32, height=24, late=0.05, rows=0.03)
        for i in (0, frames - 1):
            assert (room.frame(i).depth_m > 0.2).all()


def test_times_in_the_path() -> None:
    source = open_source("synthetic:frames=9,width=80,height=60,exposure_change=0,late=0.02,rows=0.03,depth_rows=-0.01")
    room = SyntheticRoom(frames=9, width=80, height=60, exposure_change=False, late=0.02, rows=0.03, depth_rows=-0.01)
    assert source.frame(3).depth_m.tobytes() == room.frame(3).depth_m.tobytes()
    assert source.frame(3).color.tobytes() == room.frame(3).color.tobytes()
    for wrong in ("late", "late=soon", "rows=", "depth_rows=1e9", "late=nan", "frames=0.5"):
        with pytest.raises(SourceError, match=r"unknown option .*decimals for late, rows, depth_rows"):
            open_source(f"synthetic:{wrong}")
    for other in ("stereo=10", "mover=20"):
        with pytest.raises(SourceError, match="read at once"):
            open_source(f"synthetic:{other},late=0.01")
