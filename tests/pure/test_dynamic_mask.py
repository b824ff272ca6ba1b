"""What has moved in front of the camera is told apart from what comes into view."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import label

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.plugins.sources import SyntheticRoom
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask, Earlier, dynamic_mask
from sigmasplat.tracking.moving.free_space import labelled

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed (pip install opencv-python-headless)")

Depth = NDArray[np.float32]
CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
WALL_M, OBJECT_M = 3.0, 1.0
BOX = np.s_[40:90, 50:110]


def wall() -> Depth:
    return np.full((CAMERA.height, CAMERA.width), WALL_M, np.float32)


def with_box(depth_m: Depth) -> Depth:
    covered = depth_m.copy()
    covered[BOX] = OBJECT_M
    return covered


def share(mask: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the share of the box that a mask covers, and the share of all other pixels."""
    box = np.zeros(mask.shape, bool)
    box[BOX] = True
    return float(mask[box].mean()), float(mask[~box].mean())


def found(scene_m: Depth, live_m: Depth, before: DynamicMask | None = None) -> DynamicMask | None:
    last = None if before is None else Earlier(before.depth_m, np.eye(4))
    return dynamic_mask(Earlier(scene_m, np.eye(4)), last, live_m, CAMERA)


@pytest.mark.parametrize("threads", [1, 4])
def test_regions_are_numbered_by_rows_and_connect_at_corners(threads: int) -> None:
    random, before = np.random.default_rng(0), cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        for share_inside in (0.1, 0.3, 0.5, 0.7):
            mask = random.random((240, 320)) < share_inside
            regions, boxes = labelled(mask)
            count = len(boxes)
            wanted, wanted_count = label(mask, np.ones((3, 3)))
            assert count == wanted_count
            np.testing.assert_array_equal(regions, wanted)
    finally:
        cv2.setNumThreads(before)


def test_an_object_in_front_of_a_wall_is_found() -> None:
    front = found(wall(), with_box(wall()))
    assert front is not None
    inside, outside = share(front.hidden)
    assert inside == 1.0 and outside < 0.06
    assert (front.depth_m[BOX] == OBJECT_M).mean() > 0.9
    np.testing.assert_array_equal(front.scene_m, wall())


def test_the_part_over_an_unknown_place_is_found_too() -> None:
    unknown = wall()
    unknown[:, :80] = 0.0
    front = found(unknown, with_box(wall()))
    assert front is not None and share(front.hidden)[0] > 0.95
    assert (front.hidden[:, :40]).mean() < 0.05  # the wall over the unknown place is not in front


@pytest.mark.parametrize("share_missing", [0.1, 0.4])
def test_scattered_holes_do_not_hide_an_object(share_missing: float) -> None:
    random = np.random.default_rng(0)
    scene_m, live_m = (
        np.where(random.random(wall().shape) < share_missing, np.float32(0), depth)
        for depth in (wall(), with_box(wall()))
    )
    front = found(scene_m, live_m)
    assert front is not None
    inside, outside = share(front.hidden)
    assert inside > 0.95 and outside < 0.1


def test_a_large_hole_of_the_reference_shows_nothing_in_front() -> None:
    assert found(np.where(with_box(wall()) < WALL_M, np.float32(0), wall()), with_box(wall())) is None


def test_an_object_that_stops_stays_in_front_and_the_scene_behind_it_is_known() -> None:
    first = found(wall(), with_box(wall()))
    assert first is not None
    second = found(first.scene_m, with_box(wall()), first)
    assert second is not None and share(second.hidden)[0] == 1.0
    np.testing.assert_array_equal(second.scene_m, wall())


def test_when_the_object_has_gone_nothing_is_in_front() -> None:
    first = found(wall(), with_box(wall()))
    assert first is not None
    assert found(first.scene_m, wall(), first) is None


def test_noise_is_not_in_front() -> None:
    noisy = wall() + np.random.default_rng(0).normal(0, 0.027, wall().shape).astype(np.float32)
    assert found(wall(), noisy) is None


@pytest.mark.parametrize("moved", [(0.4, 0.0, 0.0), (0.0, 0.0, -0.5), (0.3, 0.1, 0.3)])
def test_a_still_surface_that_comes_into_view_is_not_in_front(moved: tuple[float, float, float]) -> None:
    """A near screen at the side hides a part of a wall: moving aside, or back, brings more of it in front of wall that
    was seen before."""
    live_T = se3.exp(np.array([*moved, 0.0, 0.0, 0.0]))
    scene_m, live_m = screen_and_wall(np.eye(4)), screen_and_wall(live_T)
    assert dynamic_mask(Earlier(scene_m, live_T), None, live_m, CAMERA) is None


def screen_and_wall(T_world_camera: NDArray[np.float64], camera: Camera = CAMERA, wide_m: float = 9.0) -> Depth:
    """Return the depth of a wall at z = 3 m with a screen at z = 1.2 m, from x = 0.65 m on, in front of it."""
    rays, (x0, _, z0) = camera.rays() @ T_world_camera[:3, :3].T, T_world_camera[:3, 3]
    to_screen, to_wall = (1.2 - z0) / rays[..., 2], (WALL_M - z0) / rays[..., 2]
    screen = np.abs(x0 + rays[..., 0] * to_screen - 0.65 - wide_m / 2) < wide_m / 2
    return np.where(screen, to_screen, to_wall).astype(np.float32)


def turned(rad: float) -> NDArray[np.float64]:
    return se3.exp(np.array([0.0, 0.0, 0.0, 0.0, rad, 0.0]))


@pytest.mark.parametrize("error", [-0.07, 0.07])
def test_an_edge_at_a_pose_that_is_wrong_by_a_share_of_a_wide_motion_is_not_in_front(error: float) -> None:
    """The camera turns by a third of a radian, and the pose misses 7 % of it: the edge of the screen is off by pixels,
    all along. A thing that has come is still in front."""
    large = Camera(320, 240, 280.0, 280.0, 159.5, 119.5)
    T_world_earlier, T_earlier_live, estimate = (turned(rad) for rad in (0.25, 0.35, 0.35 * (1.0 + error)))
    scene = Earlier(screen_and_wall(T_world_earlier, large, wide_m=0.25), estimate)
    live_m = screen_and_wall(T_world_earlier @ T_earlier_live, large, wide_m=0.25)
    assert dynamic_mask(scene, None, live_m, large, whole_objects=True) is None
    live_m[80:180, 60:140] = OBJECT_M
    front = dynamic_mask(scene, None, live_m, large, whole_objects=True)
    assert front is not None and front.hidden[80:180, 60:140].mean() > 0.95 and front.hidden.mean() < 0.15


def test_in_a_walk_through_a_still_room_nothing_is_in_front() -> None:
    room = SyntheticRoom(frames=120, width=160, height=120, exposure_change=False)
    T = room.truth().T_world_camera
    for first in range(0, 110, 10):
        scene = Earlier(room.frame(first).depth_m, se3.inverse(T[first]) @ T[first + 5])
        assert dynamic_mask(scene, None, room.frame(first + 5).depth_m, room.camera) is None


@pytest.mark.parametrize("rows", [np.s_[55:75], np.s_[80:120]])
def test_what_is_too_near_for_the_sensor_is_hidden_with_the_object_around_it(rows: slice) -> None:
    covered = wall()
    covered[30:120, 40:120] = OBJECT_M
    covered[rows, 60:100] = 0.0
    covered[5:15, 5:15] = 0.0  # a hole in the wall is not the object's
    front = found(wall(), covered)
    assert front is not None and front.hidden[30:120, 40:120].all() and not front.hidden[5:15, 5:15].any()


def near_hole() -> Depth:
    """Return the depth of a box whose middle is too near for the sensor."""
    depth_m = with_box(wall())
    depth_m[50:80, 62:98] = 0.0
    return depth_m


def test_a_hole_in_a_thing_belongs_to_it_although_an_outline_joins_it_to_others() -> None:
    depth_m = near_hole()
    depth_m[60:62, :62] = depth_m[20:100, 20:22] = depth_m[20:22, 20:150] = 0.0  # outlines have no readings
    front = dynamic_mask(Earlier(wall(), np.eye(4)), None, depth_m, CAMERA, whole_objects=True)
    assert front is not None and front.hidden[50:80, 62:98].all()
    assert not front.hidden[20:36, 20:150].any()


def test_a_thin_rim_of_a_hole_that_is_as_far_as_the_thing_belongs_to_it() -> None:
    depth_m = near_hole()
    depth_m[50:80, 62:106] = 0.0
    depth_m[50:80, 109:] = 0.0  # the rim lies between two holes: its place is not known
    scene_m = wall()
    scene_m[:, 105:] = 0.0
    front = dynamic_mask(Earlier(scene_m, np.eye(4)), None, depth_m, CAMERA, whole_objects=True)
    assert front is not None and front.hidden[50:80, 64:100].all() and not front.hidden[50:80, 125:].any()
