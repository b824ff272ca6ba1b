"""Finding a camera in the whole map: keyframes of the synthetic room, on disk or in memory."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.submap import MemoryStore, Submap, SubmapStore
from sigmasplat.fit.references import live_image
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.plugins.sources import SyntheticRoom
from sigmasplat.render.backend import make_view
from sigmasplat.render.view import View
from sigmasplat.run_folder.submaps import DiskStore
from sigmasplat.tracking.feature_image import FeatureImage, detail_of, gray_levels, pose_by_features
from sigmasplat.tracking.features import Extractor
from sigmasplat.tracking.prepared_frame import PreparedFrame
from sigmasplat.tracking.relocaliser import KnownMap, Relocaliser, Relocation

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

CONFIG: Config = override(preset("sigma"), {"input.width": "160"})
PARTS = ((0, 10, 20), (60, 70), (120, 130))
"""The frames of the keyframes of two finished submaps and of the active one."""
AGAIN = 187
"""A frame of the second round, which begins after 182 frames: near frame 5."""
NEWEST_FIRST = [(2, 1), (2, 0), (1, 1), (1, 0), (0, 2), (0, 1), (0, 0)]


@cache
def room() -> SyntheticRoom:
    """Return a round of 182 frames and the beginning of the next."""
    return SyntheticRoom(frames=200, width=320, height=240, overrun=10)


@cache
def view() -> View:
    return make_view("cpu", room().camera.prepared(160), CONFIG.render, variance=True)


@cache
def extractor() -> Extractor:
    return Extractor()


@cache
def seen(i: int, mirrored: bool = False) -> PreparedFrame:
    """Return a frame of the walk, or of the same walk in a mirrored room: like the first one, but another place."""
    whole = room().frame(i)
    if mirrored:
        color, depth_m = (np.ascontiguousarray(image[:, ::-1]) for image in (whole.color, whole.depth_m))
        whole = replace(whole, color=color, depth_m=depth_m)
    frame = whole.prepared(160, 0.1, 8.0)
    target = Target.of(frame, (view().sums.shape[1], view().sums.shape[2]))
    image = FeatureImage(detail_of(whole), frame.depth_m, frame.camera)
    live = live_image(view(), frame.color, frame.depth_m, target)
    return PreparedFrame(target, live, image, frame=frame, whole=whole)


def anchor(part: int) -> NDArray[np.float64]:
    """Return T_room_submap: the camera of the first keyframe."""
    return room().truth().T_world_camera[PARTS[part][0]]


def pose(part: int, i: int) -> NDArray[np.float64]:
    """Return the true T_submap_camera of a frame."""
    return se3.inverse(anchor(part)) @ room().truth().T_world_camera[i]


def splats(part: int) -> GaussianField:
    """Return a splat for every pixel of the keyframes."""
    points, colors, sizes = [], [], []
    for i in PARTS[part]:
        target, T = seen(i).target, pose(part, i)
        depth = target.depth_image.numpy()
        points.append((target.camera.rays() * depth[..., None])[depth > 0] @ T[:3, :3].T + T[:3, 3])
        colors.append(target.image.numpy()[depth > 0])
        sizes.append(np.repeat((depth[depth > 0] / target.camera.fx)[:, None], 3, 1))
    as_tensor = (torch.tensor(np.concatenate(values), dtype=torch.float32) for values in (points, sizes, colors))
    return GaussianField.from_values(*as_tensor, opacities=0.9, log_variances=-6.0)


@cache
def keyframes(part: int) -> list[Keyframe]:
    return [
        Keyframe(i, seen(i).target, pose(part, i), detail=image.detail if (image := seen(i).image) else None)
        for i in PARTS[part]
    ]


def known(store: SubmapStore | None = None, wanted: Callable[[int], bool] = lambda submap: True) -> KnownMap:
    """Return the map of all parts, the first two of them in a store."""
    store = MemoryStore() if store is None else store
    poses = [[pose(part, i) for i in PARTS[part]] for part in range(3)]
    for part in range(2):
        submap = Submap(part, splats(part), PARTS[part], np.stack(poses[part]), view().camera)
        store.save(submap, [keyframe.picture() for keyframe in keyframes(part)])
    return KnownMap(store, poses, keyframes(2), splats(2), wanted)


def relocaliser() -> Relocaliser:
    return Relocaliser(CONFIG, extractor())


def off(found: Relocation | None, i: int) -> tuple[float, float]:
    """Return how far a pose is from the truth, m and degrees."""
    assert found is not None
    error = se3.inverse(pose(found.where[0], i)) @ found.T_submap_camera
    return float(np.linalg.norm(error[:3, 3])), float(np.rad2deg(se3.rotation_angle(error[:3, :3])))


def test_a_place_seen_a_round_ago_is_found_in_a_finished_submap(tmp_path: Path) -> None:
    on_disk, in_memory = (
        relocaliser().search(known(store), view(), seen(AGAIN)).found
        for store in (DiskStore(tmp_path / "s"), MemoryStore())
    )
    assert on_disk is not None and in_memory is not None
    assert on_disk.where[0] == 0 and on_disk.inliers >= 15
    metres, degrees = off(on_disk, AGAIN)
    assert metres < 0.03 and degrees < 1.0
    assert np.array_equal(on_disk.T_submap_camera, in_memory.T_submap_camera) and on_disk.where == in_memory.where
    assert np.linalg.norm(on_disk.keyframe.reference.T_camera_world @ pose(*_frame(on_disk)) - np.eye(4)) < 1e-9


def _frame(found: Relocation) -> tuple[int, int]:
    return found.where[0], PARTS[found.where[0]][found.where[1]]


@pytest.mark.parametrize(("i", "part"), [(66, 1), (127, 2)], ids=["finished", "active"])
def test_other_parts_of_the_map_are_found_too(i: int, part: int) -> None:
    found = relocaliser().search(known(), view(), seen(i)).found
    assert found is not None and found.where[0] == part and off(found, i)[0] < 0.03


def test_the_reported_covariance_covers_the_error() -> None:
    found = relocaliser().search(known(), view(), seen(AGAIN)).found
    assert found is not None
    twist = se3.log(found.T_submap_camera @ se3.inverse(pose(found.where[0], AGAIN)))
    assert np.linalg.eigvalsh(found.information).min() > 0
    assert float(twist @ found.information @ twist) < 22.5, "χ² of six dimensions at 0.999"


def test_images_of_another_room_are_not_found() -> None:
    search, map_of_room = relocaliser(), known()
    for i in (0, 10, 40, 60, 90, 150):
        assert search.search(map_of_room, view(), seen(i, mirrored=True)).found is None, i
    assert search.search(map_of_room, view(), seen(150)).found is not None, "the room itself is found"


def test_only_wanted_submaps_are_searched() -> None:
    search = relocaliser()
    found = search.search(known(wanted=lambda submap: submap != 0), view(), seen(AGAIN)).found
    assert found is None or found.where[0] != 0
    assert {submap for submap, _ in search.indexed} == {1, 2}
    found = search.search(known(), view(), seen(AGAIN)).found
    assert found is not None and found.where[0] == 0
    found = search.search(known(wanted=lambda submap: submap != 0), view(), seen(AGAIN)).found
    assert found is None or found.where[0] != 0, "also keyframes that were searched before"


def test_few_keyframes_are_added_per_call_the_newest_first() -> None:
    search, map_of_room = relocaliser(), known()
    added = []
    for _ in range(4):
        found = search.search(map_of_room, view(), seen(AGAIN), index_at_most=2).found
        added.append(len(search.indexed))
        assert found is None or found.where in search.indexed
    assert search.indexed == NEWEST_FIRST and added == [2, 4, 6, 7]
    at_once = relocaliser().search(map_of_room, view(), seen(AGAIN), index_at_most=None).found
    assert found is not None and at_once is not None and found.where == at_once.where
    assert np.array_equal(found.T_submap_camera, at_once.T_submap_camera)


def test_a_resumed_search_knows_the_same_keyframes_and_finds_the_same_pose() -> None:
    search, map_of_room = relocaliser(), known()
    for _ in range(3):
        search.search(map_of_room, view(), seen(AGAIN), index_at_most=2)
    resumed = Relocaliser(CONFIG, extractor(), list(search.indexed))
    one, other = (s.search(map_of_room, view(), seen(AGAIN), index_at_most=0).found for s in (search, resumed))
    assert search.indexed == resumed.indexed == NEWEST_FIRST[:6]
    assert one is not None and other is not None and one.where == other.where
    assert np.array_equal(one.T_submap_camera, other.T_submap_camera)


def test_an_empty_map_is_searched_in_vain() -> None:
    nothing = KnownMap(MemoryStore(), [[]], [], GaussianField.empty())
    assert relocaliser().search(nothing, view(), seen(AGAIN)).found is None


# ---- the image in which features are found


def test_the_gray_image_keeps_the_frames_own_size_up_to_a_width(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = room().frame(0)
    own = detail_of(frame)
    monkeypatch.setattr("sigmasplat.tracking.features.FEATURE_WIDTH", 160)
    small = detail_of(frame)
    assert own.gray.shape == (240, 320) and own.camera == frame.camera
    assert small.gray.shape == (120, 160) and small.camera == frame.camera.prepared(160)
    assert own.gray.reshape(120, 2, 160, 2).mean((1, 3)) == pytest.approx(small.gray, abs=1.0)


def test_gray_levels_are_the_luma_of_the_colour() -> None:
    color = np.array([[[0, 0, 0], [1, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1]]], np.float32)
    assert gray_levels(color).tolist() == [[0, 255, 76, 150, 29]]


def test_landmarks_are_the_features_with_depth() -> None:
    image = seen(0).image
    assert image is not None
    half = image.depth_m.copy()
    half[:, 80:] = 0.0
    some = FeatureImage(image.detail, half, image.camera)
    landmarks = some.landmarks(extractor())
    assert 0 < len(landmarks) < len(some.features(extractor()))
    assert landmarks.features.points[:, 0].max() < 162.0, "in pixels of the larger image"


def test_features_give_the_motion_between_two_frames() -> None:
    reference, live = seen(60).image, seen(68).image
    assert reference is not None and live is not None
    found = pose_by_features(reference.landmarks(extractor()), live, extractor(), seed=0)
    assert found is not None
    T = room().truth().T_world_camera
    error = found.T_live_reference @ se3.inverse(se3.inverse(T[68]) @ T[60])
    assert np.linalg.norm(error[:3, 3]) < 0.02 and np.rad2deg(se3.rotation_angle(error[:3, :3])) < 0.5


def test_an_image_without_texture_gives_no_motion() -> None:
    image = seen(60).image
    assert image is not None
    flat = FeatureImage(replace(image.detail, gray=np.full_like(image.detail.gray, 128)), image.depth_m, image.camera)
    assert len(flat.features(extractor())) == 0
    assert pose_by_features(image.landmarks(extractor()), flat, extractor(), seed=0) is None
    assert pose_by_features(flat.landmarks(extractor()), image, extractor(), seed=0) is None
