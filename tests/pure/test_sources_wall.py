"""The synthetic wall: depth is that of a plane, and its paint shows the motion along it or does not."""

import numpy as np
import pytest

from sigmasplat.data import se3
from sigmasplat.errors import SourceError
from sigmasplat.fit.compare import best_alignment
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from sigmasplat.plugins.sources.room.corridor import AWAY_M, PAINTS, TILE_M, WALL_STEP_M, wall_sections
from sigmasplat.plugins.sources.room.render import build_scene, render_scene
from sigmasplat.tracking.pose_validation import DOUBTFUL, SURE, p_wrong

PAINTED, TILED, BLANK = (PAINTS.index(name) + 1 for name in ("painted", "tiles", "blank"))


def wall(paint: int, frames: int = 40, noise: bool = False) -> SyntheticRoom:
    return SyntheticRoom(frames, 160, 120, wall=paint, noise=noise)


@pytest.mark.parametrize("frames", [1, 2, 40, 300])
def test_every_ray_hits_the_wall_and_the_camera_moves_along_it(frames: int) -> None:
    source = wall(BLANK, frames)
    T = source.truth().T_world_camera
    assert all(se3.is_rigid(pose, 1e-9) for pose in T)
    np.testing.assert_allclose(np.diff(T[:, 0, 3]), WALL_STEP_M)
    for i in (0, frames - 1):
        depth_m = source.exact_depth_of(i)
        assert depth_m.min() > AWAY_M * 0.95 and depth_m.max() < AWAY_M * 1.05
    y = source.true_surface().vertices[:, 1]
    assert y.min() == 0.0 and T[0, 1, 3] == -AWAY_M


def test_tiles_look_the_same_one_tile_further_and_paint_does_not() -> None:
    for paint, same in ((TILED, True), (PAINTED, False)):
        source, scene = wall(paint), build_scene(wall_sections(40), 0, wall=paint)
        T = source.truth().T_world_camera[0]
        further = T.copy()
        further[0, 3] += TILE_M
        here, there = (render_scene(scene, source.camera, pose)[0] for pose in (T, further))
        assert (np.abs(here - there).mean() < 0.002) == same
    assert wall(BLANK).frame(0).color.std((0, 1)).max() < 0.005


def test_walls_do_not_mix_with_rooms() -> None:
    for options, said in [("wall=4", "found 4"), ("wall=-1", "found -1"), ("wall=1,rooms=2", "a wall has one way"),
                          ("wall=1,corridor", "either a corridor or a wall")]:  # fmt: skip
        with pytest.raises(SourceError, match=said):
            open_source(f"synthetic:{options}")


def pyramid(source: SyntheticRoom, i: int) -> Pyramid:
    pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    frame = source.frame(i)
    return Pyramid.of(np.ascontiguousarray(frame.color.mean(-1)), frame.depth_m, frame.camera)


@pytest.mark.parametrize("off", [0.0, 0.05, 0.2, 0.5])
def test_a_blank_wall_confirms_no_pose_and_a_painted_one_only_the_right_one(off: float) -> None:
    """Depth agrees at every place along a wall. off: of the guess from the true pose, as a share of the distance."""
    for paint in (PAINTED, BLANK):
        source = wall(paint, noise=True)
        T = source.truth().T_world_camera
        T_b_a = se3.inverse(T[1]) @ T[0]
        guess = se3.exp(np.array([off * AWAY_M, 0, 0, 0, 0, 0])) @ T_b_a
        motion, seen = best_alignment(pyramid(source, 0), pyramid(source, 1), guess)
        right = np.linalg.norm((motion.T_live_reference @ se3.inverse(T_b_a))[:3, 3]) < 0.01
        assert seen.close > 0.99 and (seen.held > 0.2) == (paint == PAINTED)
        assert (p_wrong(seen) < SURE) == (right and paint == PAINTED) == (p_wrong(seen) < DOUBTFUL)
        assert right or off > 0.0 or paint == BLANK
