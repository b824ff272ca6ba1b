"""The thing that has drawn a pose is told apart from still things that look different, and from poor fits."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from paper_settings import MovingConfig, TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.fit.compare import Comparison
from sigmasplat.fit.pose import PoseFit
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.fit.target import Target
from sigmasplat.tracking.moving.dynamic_detector import DynamicDetector
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask, thinned
from sigmasplat.tracking.moving.pose_pullers import free_standing, has_drawn, is_still, shift_px, suspected
from sigmasplat.tracking.pose_validation import is_missed
from sigmasplat.tracking.prepared_frame import PreparedFrame

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
CONFIG = TrackingConfig()
WALL_M, BOX_M, HALF_M = 3.0, 1.0, 0.16
MOVED_M, BETWEEN_M = 0.06, 0.035
"""The camera moves to the right by the first distance; a pose that a box has drawn is at the second one."""


def stripes(x: NDArray[np.float64], y: NDArray[np.float64], length_m: float) -> NDArray[np.float64]:
    return 0.5 + 0.2 * np.sin(2 * np.pi * x / length_m) + 0.2 * np.sin(2 * np.pi * (y + 0.3 * x) / length_m)


def sight(camera_m: float, box_m: float, paint_m: float = 0.0, block: bool = False) -> PreparedFrame:
    """Return a frame of a striped wall with a striped box in front of it: x of camera and box; the stripes of the box
    are shifted on it by paint_m; block: a still block stands under the box, at the same distance."""
    rays = CAMERA.rays().astype(np.float64)
    on_box = camera_m + BOX_M * rays[..., 0] - box_m, BOX_M * rays[..., 1]
    box = (np.abs(on_box[0]) < HALF_M) & (np.abs(on_box[1]) < HALF_M)
    wall = stripes(camera_m + WALL_M * rays[..., 0], WALL_M * rays[..., 1], 0.5)
    x, y = camera_m + BOX_M * rays[..., 0], BOX_M * rays[..., 1]
    under = block & (np.abs(x) < 1.5 * HALF_M) & (y >= HALF_M) & (y < 2 * HALF_M) & ~box
    wall = np.where(under, stripes(x, y, 0.15), wall)
    gray = np.where(box, stripes(on_box[0] - paint_m, on_box[1], 0.2), wall).astype(np.float32)
    depth_m = np.where(box | under, BOX_M, WALL_M).astype(np.float32)
    color = np.repeat(gray[..., None], 3, -1)
    frame = Frame(0, 0.0, color, depth_m, CAMERA)
    live = Pyramid.of(gray, depth_m, CAMERA)
    return PreparedFrame(Target.of(frame, depth_m.shape), live, frame=frame, whole=frame)


def pose(camera_m: float) -> NDArray[np.float64]:
    """Return T_camera_world."""
    return se3.exp(np.array([-camera_m, 0, 0, 0, 0, 0]))


def fitted(
    seen: PreparedFrame,
    camera_m: float,
    without: DynamicMask | None = None,
    turned_rad: float = 0.0,
    block: bool = False,
) -> PoseFit:
    """Return the fit of a frame at a pose, relative to a keyframe that shows the box at x = 0."""
    live = seen.live if without is None else seen.live.hiding(without.hidden)
    turned = se3.exp(np.array([0, 0, 0, 0, turned_rad, 0]))
    fit = PoseFit(turned @ pose(camera_m), 0.0, 0.0, 0, 1.0, 1.0)
    return replace(fit, comparison=keyframe(block).compared(live, fit.T_camera_world))


def keyframe(block: bool = False) -> Reference:
    return Reference(sight(0.0, 0.0, block=block).live, np.eye(4))


def box_of(seen: PreparedFrame) -> DynamicMask:
    (found,) = suspected(keyframe(), seen, fitted(seen, BETWEEN_M), CONFIG, every=True)
    return found


def judged(seen: PreparedFrame, drawn_m: float, turned_rad: float = 0.0) -> bool:
    """Return whether the box has drawn a pose, if the pose without it is right."""
    box, drawn = box_of(seen), fitted(seen, drawn_m, turned_rad=turned_rad)
    return has_drawn(box, keyframe(), seen, drawn, fitted(seen, MOVED_M, box), contradicted=False)


def test_a_box_that_moves_with_the_camera_has_drawn_the_pose() -> None:
    assert judged(sight(MOVED_M, MOVED_M), BETWEEN_M)


@pytest.mark.parametrize("moves", [True, False])
def test_a_box_that_moves_on_a_still_block_has_drawn_the_pose(moves: bool) -> None:
    """Depth does not tell the two apart, so both are left out as one thing, of which only a part agrees with the drawn
    pose."""
    seen, drawn_m = sight(MOVED_M, MOVED_M if moves else 0.0, block=True), BETWEEN_M if moves else MOVED_M - 0.004
    drawn, whole = fitted(seen, drawn_m, block=True), keyframe(block=True)
    (thing,) = suspected(whole, seen, drawn, CONFIG, every=True)
    assert thing.hidden[80, 75] and thing.hidden[60, 80]
    assert has_drawn(thing, whole, seen, drawn, fitted(seen, MOVED_M, thing, block=True), False) == moves
    assert not moves or list(suspected(whole, seen, drawn, CONFIG, every=False))


def test_a_pose_between_two_motions_raises_suspicion_although_the_rest_does_not_agree_there() -> None:
    seen = sight(MOVED_M, MOVED_M)
    found = list(suspected(keyframe(), seen, fitted(seen, BETWEEN_M), CONFIG, every=False))
    assert len(found) == 1 and found[0].hidden[45:75, 65:95].all() and found[0].hidden.mean() < 0.2
    still = sight(MOVED_M, 0.0)
    assert not list(suspected(keyframe(), still, fitted(still, MOVED_M), CONFIG, every=False))


def test_a_box_that_looks_different_at_its_place_has_not_drawn_the_pose() -> None:
    assert not judged(sight(MOVED_M, 0.0, paint_m=0.05), MOVED_M)


def test_a_box_that_agrees_better_at_the_right_pose_has_not_drawn_the_wrong_one() -> None:
    """It has changed its look, so that it does not agree as well as the rest; the wrong pose is only a poor fit."""
    for paint_m in (-0.02, -0.01):
        assert not judged(sight(MOVED_M, 0.0, paint_m=paint_m), MOVED_M, turned_rad=0.012)


def test_a_still_box_is_told_from_one_that_moves() -> None:
    for box_m, still in ((0.0, True), (0.02, False), (MOVED_M, False)):
        seen = sight(MOVED_M, box_m)
        box = box_of(seen)
        assert is_still(box, keyframe(), seen.live, fitted(seen, MOVED_M, box)) == still
    assert not is_still(box, None, seen.live, fitted(seen, MOVED_M, box))


def test_images_that_agree_less_in_depth_and_gray_speak_against_leaving_something_out() -> None:
    whole = Comparison(0.8, 0.99, 0.01, 0.0, 0.1, 0.95, 2000)
    assert is_missed(replace(whole, close=0.93, correlation=0.89), whole)
    assert not is_missed(replace(whole, close=0.93, correlation=0.94), whole)
    assert not is_missed(replace(whole, close=0.99, correlation=0.89), whole)
    assert not is_missed(None, whole) and not is_missed(whole, None)


def test_a_still_box_has_not_drawn_a_pose_that_fits_badly() -> None:
    assert not judged(sight(MOVED_M, 0.0), BETWEEN_M)


def test_the_shift_of_a_thing_is_that_of_its_own_depth() -> None:
    box = box_of(sight(0.0, 0.0))
    assert shift_px(box, CAMERA, pose(MOVED_M)) == pytest.approx(CAMERA.fx * MOVED_M / BOX_M, rel=1e-4)
    assert shift_px(box, CAMERA, np.eye(4)) == 0.0


def test_what_another_thing_hides_in_part_does_not_stand_free() -> None:
    depth_m = np.full((CAMERA.height, CAMERA.width), WALL_M, np.float32)
    depth_m[40:80, 60:100] = BOX_M
    assert len(list(free_standing(thinned(depth_m, 2)))) == 1
    depth_m[30:90, 20:60] = depth_m[20:40, 40:110] = depth_m[80:100, 40:110] = BOX_M / 2
    assert not any(inside[25:35, 35:45].any() for inside in free_standing(thinned(depth_m, 2)))


@pytest.mark.parametrize(("far_depth", "things"), [(True, 1), (False, 0)])
def test_what_hides_most_of_the_readings_is_the_scene(far_depth: bool, things: int) -> None:
    """Where hardly anything but a near box has depth, its motion is that of the camera."""
    seen = sight(MOVED_M, MOVED_M)
    depth_m, around = seen.target.depth_image.numpy().copy(), np.zeros((CAMERA.height, CAMERA.width), np.bool_)
    around[34:87, 52:108] = True  # with these readings the box stands free
    depth_m[~around & (not far_depth)] = 0.0
    found = suspected(keyframe(), seen.with_depth(depth_m), fitted(seen, BETWEEN_M), CONFIG, every=True)
    assert len(list(found)) == things


@pytest.mark.parametrize(("width_px", "left"), [(50, True), (120, False)])
def test_what_has_left_a_keyframe_is_never_most_of_it(width_px: int, left: bool) -> None:
    """A board that has gone is taken out of the keyframe; where most seems to have gone, the pose is wrong."""
    before_m = np.full((CAMERA.height, CAMERA.width), WALL_M, np.float32)
    before_m[:, 10 : 10 + width_px] = BOX_M
    shown = Reference(Pyramid.of(sight(0.0, 0.0).live.gray[0], before_m, CAMERA), np.eye(4))
    seen = sight(0.0, 0.0).with_depth(np.full_like(before_m, WALL_M))
    kept = DynamicDetector(MovingConfig(find=True)).without_gone(shown, seen, np.eye(4))
    assert kept is not None and (kept is not shown) == left
    board = kept.pyramid.depth[0][:, 20:width_px]
    assert (board == 0).mean() > 0.9 if left else (board > 0).all()


def look(watch: DynamicDetector, contradicted: bool = False, urgent: bool = False) -> tuple[DynamicDetector, bool]:
    """Return the watch after a look for the box that has drawn a pose, and whether it finds it."""
    seen = sight(MOVED_M, MOVED_M)
    later, things = watch.suspected(keyframe(), seen, fitted(seen, BETWEEN_M), CONFIG, contradicted, urgent)
    return later, bool(list(things))


def test_what_draws_the_pose_is_looked_for_less_often_after_looks_in_vain() -> None:
    seen, watch = sight(0.0, 0.0), DynamicDetector(MovingConfig(find=True))
    box, found, urgent = box_of(sight(MOVED_M, MOVED_M)), list[bool](), list[bool]()
    for _ in range(16):
        assert look(watch, contradicted=True)[1]
        urgent.append(look(watch, urgent=True)[1])
        watch, looked = look(watch)
        found.append(looked)
        watch = watch.after(seen, None, np.eye(4))
    assert found == [n % (2 if n < 6 else 4) == 0 for n in range(16)]
    assert urgent == [n < 5 or n % 2 == 0 for n in range(16)]
    for front in (box, None):  # something was in front: frame 18 is looked at again
        watch = watch.after(seen, front, np.eye(4))
    assert look(watch)[1] and not look(watch.after(seen, None, np.eye(4)))[1]
    for _ in range(30):  # where nothing differs, nothing is looked for
        watch, things = watch.suspected(keyframe(), seen, fitted(seen, 0.0), CONFIG, False, False)
        assert not list(things)
        watch = watch.after(seen, None, np.eye(4))
    assert look(watch)[1] and not look(watch.after(seen, None, np.eye(4)))[1]


def test_a_box_is_not_suspected_for_a_pose_where_depth_does_not_agree() -> None:
    """A wall whose paint has moved: gray agrees better at a pose that depth contradicts, without the box or with it."""
    seen = sight(MOVED_M, 0.0)
    wall = seen.target.depth_image.numpy() == WALL_M
    gray = np.where(wall, np.roll(seen.live.gray[0], 6, 1), seen.live.gray[0])
    painted = replace(seen, live=Pyramid.of(gray, seen.target.depth_image.numpy(), CAMERA))
    assert not list(suspected(keyframe(), painted, fitted(painted, MOVED_M), CONFIG, every=False))
