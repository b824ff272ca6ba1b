"""The atlas: corrections move anchors only; and what may be kept in a store."""

import numpy as np
import pytest

from sigmasplat.errors import SigmaSplatError
from sigmasplat.model import se3
from sigmasplat.model.atlas import Atlas
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.submap import MemoryStore, Picture, Submap

CAMERA = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)


def motion(seed: int) -> np.ndarray:
    return se3.exp(np.random.default_rng(seed).normal(0.0, 0.4, 6))


def two_submaps() -> tuple[Atlas, list[np.ndarray]]:
    """Four frames in two submaps of two keyframes, and where they were put, in the world."""
    atlas, world = Atlas(), []
    for submap in range(2):
        anchor = np.eye(4) if submap == 0 else motion(9)
        atlas.begin_submap(anchor if submap else None)
        for frame in range(2):
            T_submap_camera = motion(10 * submap + frame)
            atlas.keyframe_poses[-1].append(motion(50 + frame) if frame else np.eye(4))
            atlas.place_frame(T_submap_camera)
            world.append(anchor @ T_submap_camera)
    return atlas, world


def test_frames_are_where_they_were_put() -> None:
    atlas, world = two_submaps()
    assert np.allclose(atlas.T_world_camera(), world)
    assert [place.submap for place in atlas.places] == [0, 0, 1, 1]


def test_moving_an_anchor_moves_its_own_frames_and_keyframes_and_no_others() -> None:
    atlas, world = two_submaps()
    correction, keyframes = motion(77), atlas.T_world_keyframe(1)
    atlas.anchors[1] = correction @ atlas.anchors[1]
    assert np.allclose(atlas.T_world_camera()[:2], world[:2])
    assert np.allclose(atlas.T_world_camera(loops=False), world), "tracking alone knows of no correction"
    assert np.allclose(atlas.T_world_camera()[2:], correction @ np.array(world[2:]))
    assert np.allclose(atlas.T_world_keyframe(1), correction @ keyframes)


def test_a_frame_follows_its_keyframe() -> None:
    atlas, world = two_submaps()
    moved = motion(5)
    atlas.keyframe_poses[1][1] = moved @ atlas.keyframe_poses[1][1]
    assert np.allclose(atlas.T_world_camera()[3], atlas.anchors[1] @ moved @ se3.inverse(atlas.anchors[1]) @ world[3])


def test_an_atlas_without_frames_has_no_poses() -> None:
    assert Atlas().T_world_camera().shape == (0, 4, 4)


def piece(index: int, keyframes: int = 1) -> Submap:
    return Submap(index, GaussianField.empty(), tuple(range(keyframes)), np.stack([np.eye(4)] * keyframes), CAMERA)


def picture() -> Picture:
    return Picture(np.full((3, 4, 3), 51, np.uint8), np.ones((3, 4), np.float32))


def test_the_memory_store_gives_back_what_it_took() -> None:
    store = MemoryStore()
    store.save(piece(0, 2), [picture(), picture()])
    assert len(store) == 1
    assert store.load(0).frames == (0, 1)
    assert np.allclose(store.picture(0, 1).unit_color, 0.2)


def test_submaps_are_kept_in_order_and_with_all_their_pictures() -> None:
    store = MemoryStore()
    with pytest.raises(SigmaSplatError, match="submap 1 cannot be saved: the next index is 0"):
        store.save(piece(1), [picture()])
    with pytest.raises(SigmaSplatError, match="2 frames, 2 poses, 1 pictures"):
        store.save(piece(0, 2), [picture()])
    assert len(store) == 0
