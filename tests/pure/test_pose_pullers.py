"""The thing that has pulled a pose is told apart from still things, by how far away the rest wants the camera."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from paper_settings import MovingConfig, TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.fit.pose import PoseFit, fit_pose_align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.fit.target import Target
from sigmasplat.tracking.moving.dynamic_detector import DynamicDetector
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask, thinned
from sigmasplat.tracking.moving.pose_pullers import free_standing, has_pulled, suspected, thing_of
from sigmasplat.tracking.prepared_frame import PreparedFrame

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
CONFIG = TrackingConfig(method="align", verify=True)
WALL_M, BOX_M, HALF_M = 3.0, 1.0, 0.16
MOVED_M = 0.06
"""The camera moves to the right by this distance."""


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


def keyframe(block: bool = False) -> Reference:
    return Reference(sight(0.0, 0.0, block=block).live, np.eye(4))


def fitted(seen: PreparedFrame, without: DynamicMask | None = None, block: bool = False) -> PoseFit:
    """Return the fit of a frame to a keyframe that shows the box at x = 0, from rest."""
    live = seen.live if without is None else seen.live.hiding(without.hidden)
    return fit_pose_align(keyframe(block), live, np.eye(4), CONFIG)


def x_of(fit: PoseFit) -> float:
    return float(-fit.T_camera_world[0, 3])


def box_of(seen: PreparedFrame) -> DynamicMask:
    """Return the box, whether it moves or not."""
    (inside,) = free_standing(thinned(seen.target.depth_image.numpy(), 2))
    return thing_of(inside, seen.target.depth_image.numpy())


MOVES = {"with the camera": (MOVED_M, MOVED_M), "slowly": (MOVED_M, 0.02), "while the camera rests": (0.0, 0.02)}


@pytest.mark.parametrize("block", [False, True])
@pytest.mark.parametrize(("camera_m", "box_m"), MOVES.values(), ids=MOVES)
def test_a_box_that_moves_has_pulled_the_pose(camera_m: float, box_m: float, block: bool) -> None:
    """With a still block under it, depth does not tell the two apart, so both are left out as one thing."""
    seen = sight(camera_m, box_m, block=block)
    pulled = fitted(seen, block=block)
    (thing,) = suspected(seen, pulled)
    assert thing.hidden[60, 80] and thing.hidden.mean() < 0.25 and (thing.hidden[80, 75] or not block)
    found = fitted(seen, thing, block)
    assert abs(x_of(pulled) - camera_m) > 0.001 and abs(x_of(found) - camera_m) < 0.0002
    assert has_pulled(pulled, found)


@pytest.mark.parametrize("block", [False, True])
def test_a_still_box_is_not_suspected(block: bool) -> None:
    for camera_m in (0.0, 0.02, MOVED_M):
        seen = sight(camera_m, 0.0, block=block)
        pulled = fitted(seen, block=block)
        assert camera_m == 0.0 or not list(suspected(seen, pulled))  # at rest the images are the same bit by bit
        assert not has_pulled(pulled, fitted(seen, box_of(seen), block))


def test_a_still_box_with_another_look_does_not_keep_the_pose() -> None:
    """Its stripes have moved, as on a screen: gray pulls the pose, and without the box it is right."""
    for paint_m in (0.05, -0.02):
        seen = sight(MOVED_M, 0.0, paint_m=paint_m)
        pulled = fitted(seen)
        (thing,) = suspected(seen, pulled)
        found = fitted(seen, thing)
        assert has_pulled(pulled, found) and abs(x_of(found) - MOVED_M) < 0.0002 < abs(x_of(pulled) - MOVED_M)


def test_the_limit_grows_with_the_odds_that_the_other_pose_is_wrong() -> None:
    """A pose that explains less of the images needs more evidence than that it is another one."""
    seen = sight(MOVED_M, 0.02)
    pulled = fitted(seen)
    found = fitted(seen, box_of(seen))
    assert found.comparison is not None and has_pulled(pulled, found)
    doubtful = replace(found, comparison=replace(found.comparison, behind=0.4, close=0.6, correlation=0.5))
    assert not has_pulled(pulled, doubtful)


def noisy(seen: PreparedFrame, random: np.random.Generator) -> PreparedFrame:
    """Return a frame with the noise of a camera and of structured light."""
    gray, depth_m = seen.live.gray[0], seen.target.depth_image.numpy()
    gray = gray + 0.01 * random.standard_normal(gray.shape)
    depth_m = (depth_m + 0.003 * depth_m**2 * random.standard_normal(depth_m.shape)).astype(np.float32)
    return replace(seen, live=Pyramid.of(gray.astype(np.float32), depth_m, CAMERA))


@pytest.mark.parametrize("seed", range(5))
def test_noise_pulls_no_pose(seed: int) -> None:
    """Noise shrinks the motion, and more so without the box, the only thing that is near."""
    random = np.random.default_rng(seed)
    reference = Reference(noisy(sight(0.0, 0.0), random).live, np.eye(4))
    seen = noisy(sight(MOVED_M, 0.0), random)
    box = box_of(sight(MOVED_M, 0.0))
    whole, rest = (fit_pose_align(reference, live, np.eye(4), CONFIG) for live in (seen.live, seen.hiding(box)))
    assert not has_pulled(whole, rest)


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
    bare = seen.with_depth(depth_m)
    assert len(list(suspected(bare, fitted(bare)))) == things


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
