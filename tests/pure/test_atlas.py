"""The atlas: corrections move anchors only; and what may be kept in a store."""

import numpy as np
import pytest

from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.poses import Column, Place, Places
from sigmasplat.data.relative_pose import UNKNOWN_HOP, RelativePose
from sigmasplat.data.submap import MemoryStore, Picture, Submap
from sigmasplat.final.stores import RefinedStore, StorePart
from sigmasplat.system.array_interface import correction_since

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
            new = motion(50 + frame) if frame else np.eye(4)
            hop = RelativePose.hop(se3.inverse(new) @ atlas.keyframe_poses.last[-1]) if frame else UNKNOWN_HOP
            atlas.set_keyframes([*atlas.keyframe_poses.last, new], hop)
            atlas.place_frame(T_submap_camera)
            world.append(anchor @ T_submap_camera)
    return atlas, world


def test_frames_are_where_they_were_put() -> None:
    atlas, world = two_submaps()
    assert np.allclose(atlas.T_world_camera(), world)
    assert [place.submap for place in atlas.places] == [0, 0, 1, 1]


def test_moving_an_anchor_moves_its_own_frames_and_keyframes_and_no_others() -> None:
    atlas, world = two_submaps()
    correction, keyframes = motion(77), atlas.T_world_keyframes_of([1])[1]
    atlas.anchors[1] = correction @ atlas.anchors[1]
    assert np.allclose(atlas.T_world_camera()[:2], world[:2])
    assert np.allclose(atlas.T_world_camera(loops=False), world), "tracking alone knows of no correction"
    assert np.allclose(atlas.T_world_camera()[2:], correction @ np.array(world[2:]))
    assert np.allclose(atlas.T_world_keyframes_of([1])[1], correction @ keyframes)


def test_a_frame_follows_its_keyframe() -> None:
    atlas, world = two_submaps()
    moved = motion(5)
    atlas.keyframe_poses[1][1] = moved @ atlas.keyframe_poses[1][1]
    assert np.allclose(atlas.T_world_camera()[3], atlas.anchors[1] @ moved @ se3.inverse(atlas.anchors[1]) @ world[3])


def test_a_correction_leaves_out_a_frame_that_has_become_a_keyframe_since() -> None:
    atlas, _ = two_submaps()
    before, new = atlas.copied(), motion(3)
    atlas.set_keyframes([*atlas.keyframe_poses.last, new], RelativePose.hop(np.eye(4)))
    atlas.place_again(new)  # of a sensor that reads late: it is mapped with the next frame
    atlas.place_frame(motion(4))
    atlas.anchors[1] = motion(7) @ atlas.anchors[1]
    correction = correction_since(before, atlas)
    assert correction is not None and correction.reason == "loop" and correction.frames.tolist() == [2]


def test_hops_to_keyframes_are_read_as_they_were_set() -> None:
    """Their number grows past the space that is first reserved; an earlier session's keyframes have none."""
    atlas, rng, known = Atlas(), np.random.default_rng(0), list[RelativePose]()
    atlas.add_finished(np.eye(4), [np.eye(4)] * 2)
    for submap in range(1, 41):
        atlas.begin_submap(motion(submap))
        for k in range(3):
            measured = motion(100 * submap + k), rng.normal(size=(6, 6)), rng.normal(size=6)
            hop = RelativePose.hop(*measured) if k else UNKNOWN_HOP
            atlas.set_keyframes([np.eye(4)] * (k + 1), hop)
            known.append(hop)
    hops = atlas.hops
    assert len(hops) == 122 and [hop.total_covariance for hop in hops[:2]] == [None] * 2
    for found, set_before in zip(hops[2:], known, strict=True):
        assert found.kind == set_before.kind == "hop"
        for name in ("T_a_b", "covariance", "bias"):
            assert np.array_equal(getattr(found, name), getattr(set_before, name), equal_nan=True)
    np.testing.assert_array_equal(hops.covariance[-1], known[-1].covariance)
    np.testing.assert_array_equal(hops.T_camera_before[3], known[1].T_a_b)
    np.testing.assert_array_equal(hops.bias[-3:], [hop.bias for hop in known[-3:]])
    assert np.isnan(hops[0].covariance).all() and np.isnan(hops.covariance[1]).all()


def test_frames_follow_the_refined_poses_of_their_keyframes() -> None:
    atlas, world = two_submaps()
    moved = motion(6)
    atlas.refined = {1: [moved @ T for T in atlas.keyframe_poses[1]]}
    at = atlas.anchors[1] @ moved @ se3.inverse(atlas.anchors[1])
    assert np.allclose(atlas.T_world_camera(), [*world[:2], at @ world[2], at @ world[3]])
    assert np.allclose(atlas.T_world_camera(loops=False), world), "tracking alone knows of no refinement"
    assert np.allclose(atlas.T_submap_camera[2:], se3.inverse(atlas.anchors[1]) @ np.array(world[2:]))
    assert np.allclose(atlas.T_world_keyframes_of([1])[1], [atlas.anchors[1] @ T for T in atlas.refined[1]])


def test_corrections_change_steadily_from_keyframe_to_keyframe() -> None:
    """Ten frames, keyframes at 0, 4 and 8: the second one moves by 8 mm, so each frame before it by 2 mm more."""
    atlas = Atlas()
    atlas.begin_submap()
    T = [se3.exp(np.array([0.1 * i, 0.0, 0.0, 0.0, 0.0, 0.0])) for i in range(10)]
    for i in range(10):
        if i % 4 == 0:
            hop = RelativePose.hop(se3.inverse(T[i]) @ T[i - 4]) if i else UNKNOWN_HOP
            atlas.set_keyframes([*atlas.keyframe_poses.last, T[i]], hop)
        atlas.place_frame(T[i])
    aside = se3.exp(np.array([0.0, 0.008, 0.0, 0.0, 0.0, 0.0]))
    atlas.refined = {0: [T[0], aside @ T[4], aside @ T[8]]}
    moved_mm = 1000.0 * atlas.T_world_camera()[:, 1, 3]
    assert np.allclose(moved_mm, [0, 2, 4, 6, 8, 8, 8, 8, 8, 8])
    atlas.refined, atlas.follows = {}, True
    atlas.keyframe_poses.last[1:] = [aside @ T[4], aside @ T[8]]  # the growing graph has moved them
    assert np.allclose(1000.0 * atlas.T_world_camera()[:, 1, 3], moved_mm)


def test_probe_views_follow_as_frames_do_in_the_final_map() -> None:
    T, probe, moved = np.array([motion(1), motion(2)]), motion(3), [motion(4), motion(5)]
    store, picture = MemoryStore(), Picture(np.zeros((3, 4, 3), np.uint8), np.ones((3, 4), np.float32))
    store.save(Submap(0, GaussianField.empty(), (0, 8), T, CAMERA, (5,), probe[None]), [picture] * 2, [picture])
    submap = RefinedStore(store, [moved]).load(0)
    assert np.allclose(submap.T_submap_camera, moved)
    first, last = (new @ se3.inverse(old) for new, old in zip(moved, T, strict=True))
    at_frame_5 = se3.exp(5 / 8 * se3.log(last @ se3.inverse(first))) @ first  # of 8 frames between the keyframes
    assert np.allclose(submap.T_submap_probe[0], at_frame_5 @ probe)


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


def test_submaps_are_kept_in_order() -> None:
    store = MemoryStore()
    with pytest.raises(AssertionError, match="in their order"):
        store.save(piece(1), [picture()])
    with pytest.raises(AssertionError, match="with all images"):
        store.save(piece(0, 2), [picture()])
    assert len(store) == 0


# ---- components


def three_components() -> Atlas:
    """Return an atlas of submaps 0 and 1 (the world), 2 and 3, 4; two frames per submap, one keyframe each."""
    atlas = Atlas()
    for s in range(5):
        atlas.begin_submap(None if s in (0, 2, 4) else motion(s))
        atlas.set_keyframes([np.eye(4)], UNKNOWN_HOP)
        for frame in range(2):
            atlas.place_frame(motion(20 * s + frame))
    return atlas


def test_a_submap_without_a_pose_begins_a_component_at_its_own_origin() -> None:
    atlas = three_components()
    assert atlas.components == [0, 0, 1, 1, 2]
    assert [atlas.members(n) for n in range(3)] == [[0, 1], [2, 3], [4]]
    for s in (0, 2, 4):
        assert np.array_equal(atlas.anchors[s], np.eye(4))
    assert np.allclose(atlas.anchors[3], motion(3)), "relative to its own component"
    assert atlas.in_world.tolist() == [True] * 4 + [False] * 6


def test_a_submap_may_begin_in_any_other_one() -> None:
    atlas = three_components()
    atlas.begin_submap(motion(7), 1)
    assert atlas.components[-1] == 0
    assert np.allclose(atlas.anchors[-1], atlas.anchors[1] @ motion(7))
    assert np.allclose(atlas.odometry[-1], atlas.odometry[1] @ motion(7))


@pytest.mark.parametrize("reverse", [False, True], ids=["world first", "world second"])
def test_a_component_that_joins_moves_rigidly_to_the_world(reverse: bool) -> None:
    atlas, before = three_components(), three_components()
    T_1_3 = motion(50)
    if reverse:
        atlas.join(3, 1, se3.inverse(T_1_3))
    else:
        atlas.join(1, 3, T_1_3)
    assert atlas.components == [0, 0, 0, 0, 2]
    for chain, old in ((atlas.anchors, before.anchors), (atlas.odometry, before.odometry)):
        assert np.allclose(se3.inverse(chain[1]) @ chain[3], T_1_3), "the observation holds exactly"
        assert np.allclose(se3.inverse(chain[2]) @ chain[3], se3.inverse(old[2]) @ old[3]), "its inside is unchanged"
        assert all(np.array_equal(chain[s], old[s]) for s in (0, 1, 4)), "the others stay"
        assert all(se3.is_rigid(T, 1e-9) for T in chain)
    moved = atlas.anchors[2] @ se3.inverse(before.anchors[2])
    assert np.allclose(atlas.T_world_camera()[4:8], moved @ before.T_world_camera()[4:8])
    assert atlas.in_world.tolist() == [True] * 8 + [False] * 2


def test_components_outside_the_world_join_each_other_under_the_lower_number() -> None:
    atlas = three_components()
    atlas.join(4, 2, motion(60))
    assert atlas.components == [0, 0, 1, 1, 1] and np.array_equal(atlas.anchors[2], np.eye(4))
    assert np.allclose(se3.inverse(atlas.anchors[4]) @ atlas.anchors[2], motion(60))
    atlas.join(0, 4, motion(61))
    assert atlas.components == [0] * 5 and atlas.in_world.all()
    assert np.allclose(se3.inverse(atlas.anchors[4]) @ atlas.anchors[2], motion(60))


def test_a_loop_before_a_join_is_kept_apart_from_the_path_without_loops() -> None:
    """Anchors and odometry differ after a loop; each chain gets the component at the observed pose."""
    atlas = three_components()
    atlas.anchors[1] = motion(70) @ atlas.anchors[1]
    atlas.join(1, 2, motion(71))
    assert np.allclose(atlas.anchors[2], atlas.anchors[1] @ motion(71))
    assert np.allclose(atlas.odometry[2], atlas.odometry[1] @ motion(71))
    assert not np.allclose(atlas.anchors[2], atlas.odometry[2])


def test_a_part_of_a_store_numbers_its_submaps_anew() -> None:
    store = MemoryStore()
    for k in range(4):
        some = Picture(np.full((3, 4, 3), k, np.uint8), np.ones((3, 4), np.float32))
        store.save(piece(k), [some])
    part = StorePart(store, [3, 1])
    assert len(part) == 2
    assert [part.load(k).index for k in range(2)] == [3, 1]
    assert [int(part.picture(k, 0).color[0, 0, 0]) for k in range(2)] == [3, 1]


def test_places_of_thousands_of_frames_are_kept_as_they_were_appended() -> None:
    places, rng = Places(), np.random.default_rng(0)
    poses = rng.normal(size=(3000, 4, 4))
    early = places.first(0)
    for i, T in enumerate(poses):
        places.append(Place(i // 12, i % 12, T))
        early = places.first(5) if i == 4 else early
    assert len(places) == 3000 and len(early) == 5
    np.testing.assert_array_equal(places.T_keyframe_camera, poses)
    assert places.submap.tolist() == [i // 12 for i in range(3000)] and places[-1].keyframe == 2999 % 12
    taken = places[7]
    taken.T_keyframe_camera[:] = 0.0
    assert np.array_equal(places[7].T_keyframe_camera, poses[7]), "a place is a copy"
    assert [place.submap for place in early] == [0] * 5 and [p.keyframe for p in places[10:14]] == [10, 11, 0, 1]
    with pytest.raises(ValueError, match="cannot hold 4"):
        Column(np.zeros(3), 4)
