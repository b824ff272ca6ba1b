"""The synthetic corridor: exact steps, exact images, and walls on which alignment slides."""

import numpy as np
import pytest

from sigmasplat.data import se3
from sigmasplat.errors import SourceError
from sigmasplat.fit.align import align
from sigmasplat.fit.compare import best_alignment, compare
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from sigmasplat.plugins.sources.room.corridor import AHEAD_M, HALF_WIDTH_M, corridor_path, furnish_corridor, sections
from sigmasplat.plugins.sources.room.furnish import HALF_X_M, HEIGHT_M, PITCH_M
from sigmasplat.plugins.sources.room.render import build_scene, render_scene
from view_agreement import agreement

PLAIN = 110
"""A frame that sees nothing but plain walls near the camera."""


@pytest.mark.parametrize(("frames", "seed"), [(1, 0), (2, 0), (200, 0), (200, 3), (700, 1)])
def test_the_camera_moves_80_mm_a_frame_within_the_corridor(frames: int, seed: int) -> None:
    T = corridor_path(frames, seed)
    assert T.shape == (frames, 4, 4) and all(se3.is_rigid(pose, 1e-9) for pose in T)
    np.testing.assert_allclose(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1), 0.08, rtol=1e-12)
    x, y, z = T[:, :3, 3].T
    assert np.abs(y).max() < HALF_WIDTH_M - 0.5 and z.min() > 1.2 and z.max() < HEIGHT_M - 0.5
    end_m = sections(frames) * PITCH_M - HALF_X_M
    assert x[0] == pytest.approx(-1.8) and AHEAD_M - 0.2 < end_m - x[-1] < AHEAD_M + PITCH_M + 0.3
    assert (np.diff(x) > 0.07).all() and (T[:, 0, 2] > 0.9).all(), "it looks where it goes"


def test_two_views_agree_in_depth_and_colour() -> None:
    """Even light and matt surfaces: a point has the same colour in each view, up to what a pixel averages."""
    corridor = SyntheticRoom(width=160, height=120, corridor=True)
    behind_m, near = agreement(corridor, 20, 22)
    assert near.mean() > 0.8  # far walls are seen at a small angle: half a pixel is more than 5 cm there
    assert np.median(np.abs(behind_m[near])) < 0.01
    colors = [corridor.frame(i).color.reshape(-1, 3).mean(0) for i in (PLAIN, PLAIN + 40)]
    np.testing.assert_allclose(*colors, atol=0.01)


def test_every_ray_hits_the_corridor() -> None:
    for frames, i in [(1, 0), (70, 0), (70, 69), (130, 129)]:
        depth_m = SyntheticRoom(frames=frames, width=64, height=48, corridor=True).exact_depth_of(i)
        assert depth_m.min() > 0.4 and depth_m.max() < frames * 0.08 + AHEAD_M + PITCH_M + 1


def halved(image: np.ndarray) -> np.ndarray:
    return (image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2]) / 4


def test_only_speckle_shows_the_motion_along_plain_walls() -> None:
    """Two views 8 cm apart, with the same rotation and place across the corridor: their depth images are the same, and
    so are their gray images but for the speckle on near walls. The smallest image shows it in a few pixels."""
    corridor = SyntheticRoom(corridor=True)
    T, scene = corridor.truth().T_world_camera[PLAIN], build_scene(sections(200), 0, True)
    ahead = T.copy()
    ahead[0, 3] += 0.08
    (here, depth_m), (there, depth_ahead_m) = (render_scene(scene, corridor.camera, pose) for pose in (T, ahead))
    near = (depth_m < 3.0) & (depth_ahead_m < 3.0)
    assert near.mean() > 0.5 and np.abs(depth_m - depth_ahead_m)[near].max() < 1e-3
    speckle = np.where(near, (here - there).mean(-1), 0.0)
    full, small = (np.abs(image) > 2 / 255 for image in (speckle, halved(halved(halved(speckle)))))
    assert full.mean() > 0.08 and full.sum() > 6000
    assert small.mean() < 0.08 and small.sum() < 100


@pytest.mark.slow
def test_coarse_to_fine_slides_along_the_corridor_and_nothing_shows_it() -> None:
    """What the corridor is for: from a good guess, alignment from coarse to fine goes centimetres astray while depth
    agrees everywhere; the finest size alone stays."""
    corridor, gray = SyntheticRoom(corridor=True), np.array([0.299, 0.587, 0.114], np.float32)
    T, pyramids = corridor.truth().T_world_camera, {}
    for i in range(40, 100):
        frame = corridor.frame(i)
        pyramids[i] = Pyramid.of(np.ascontiguousarray(frame.color @ gray), frame.depth_m, frame.camera)
    off_m: dict[str, list[float]] = {"coarse to fine": [], "finest": [], "best": []}
    for i in range(42, 100):
        motion = se3.inverse(T[i]) @ T[i - 2]
        guess = se3.inverse(T[i - 1] @ se3.inverse(T[i - 2]) @ T[i - 1]) @ T[i - 2]  # constant velocity
        pair = pyramids[i - 2], pyramids[i]
        finest = [image.finest() for image in pair]
        fits = (align(*pair, guess, weight_color=0.1), align(*finest, guess, weight_color=0.1))
        for name, found in zip(off_m, (*fits, best_alignment(*pair, guess, 0.1)[0]), strict=True):
            off_m[name].append(float(np.linalg.norm((se3.inverse(motion) @ found.T_live_reference)[:3, 3])))
            assert compare(*pair, found.T_live_reference).close > 0.98
    assert max(off_m["coarse to fine"]) > 0.04 and sum(np.array(off_m["coarse to fine"]) > 0.02) >= 2
    assert max(off_m["finest"]) < 0.01 and max(off_m["best"]) < 0.01


def test_the_first_section_shows_how_fast_the_camera_goes() -> None:
    first, later = (
        [s.material.texture(*np.zeros((3, 1), np.float32)).ravel() for s in shapes]
        for shapes in furnish_corridor(2, 0)
    )  # fmt: skip
    assert len(first) == len(later) + 10, "paintings"
    assert np.ptp(first, axis=0).max() > np.ptp(later, axis=0).max()


def test_exposure_is_constant_unless_asked_for() -> None:
    options = {"frames": 9, "width": 32, "height": 24, "corridor": True}
    steady, swings = SyntheticRoom(**options), SyntheticRoom(**options, exposure_change=True)
    exact = render_scene(build_scene(sections(9), 0, True), steady.camera, steady.truth().T_world_camera[2])[0]
    np.testing.assert_allclose(steady.frame(2).color, exact, atol=0.5001 / 255)
    assert swings.frame(2).color.mean() > 1.04 * exact.mean()


def test_options_of_the_corridor() -> None:
    first, second = open_source("synthetic:corridor,frames=3,width=32,height=24"), open_source(
        "synthetic:frames=3,width=32,height=24,corridor=1"
    )  # fmt: skip
    assert first.frame(2).color.tobytes() == second.frame(2).color.tobytes()
    assert first.camera.fx == 16.0, "a wide lens"
    assert not np.array_equal(first.frame(2).color, open_source(
        "synthetic:corridor,frames=3,width=32,height=24,seed=1").frame(2).color)  # fmt: skip
    noisy = open_source("synthetic:corridor,frames=3,width=64,height=48,noise,test_views=2")
    assert (noisy.frame(1).depth_m == 0).any() and len(noisy.test_views()) == 2
    assert open_source("synthetic:corridor=0,frames=3").camera.fx == 256.0
    for option in ("rooms=2", "loops=2", "overrun=10", "mover=20"):
        with pytest.raises(SourceError, match="a corridor has one way; leave out rooms, loops, overrun and mover"):
            open_source(f"synthetic:corridor,{option}")
    assert len(open_source("synthetic:corridor,frames=3").true_surface().vertices) > 100
