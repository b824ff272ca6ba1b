"""The benchmark of relocalisation: it chooses pairs that see the same surface, counts what is right, and tabulates."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from benchmark_results import laid_out
from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset
from sigmasplat.data import se3
from sigmasplat.errors import SourceError
from sigmasplat.plugins.sources.synthetic import SyntheticRoom

known_map, relocalisation = map(importlib.import_module, ("known_map", "relocalisation"))


@pytest.fixture(scope="module")
def room() -> SyntheticRoom:
    """A path that is walked twice."""
    return SyntheticRoom(frames=120, width=320, height=240, loops=2)


def test_pairs_see_the_same_surface_from_far_frames() -> None:
    room = SyntheticRoom(frames=120, width=80, height=60)
    poses = room.truth().T_world_camera
    chosen = relocalisation.choose_pairs(room, poses, 4, 0)
    assert len({(pair.reference, pair.live) for pair in chosen}) == 4
    for pair in chosen:
        assert abs(pair.reference - pair.live) >= relocalisation.APART
        assert np.allclose(pair.T_live_reference, se3.inverse(poses[pair.live]) @ poses[pair.reference])
        assert np.degrees(se3.rotation_angle(pair.T_live_reference[:3, :3])) <= relocalisation.TURN_DEG
    again = relocalisation.choose_pairs(room, poses, 4, 0)
    assert [(pair.reference, pair.live) for pair in again] == [(pair.reference, pair.live) for pair in chosen]
    with pytest.raises(SourceError, match="only 0 of 4 pairs"):
        relocalisation.choose_pairs(room, poses[: relocalisation.APART], 4, 0)


def test_overlap_is_the_share_of_common_surface(room: SyntheticRoom) -> None:
    frame = room.frame(0).prepared(40, 0.1, 8.0)
    depth, camera = frame.depth_m, frame.camera
    assert relocalisation.overlap(depth, camera, depth, camera, np.eye(4)) == 1.0
    assert relocalisation.overlap(depth, camera, depth + np.float32(1), camera, np.eye(4)) == 0.0
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert relocalisation.overlap(depth, camera, depth, camera, away) == 0.0


@pytest.mark.parametrize(("centimetres", "degrees", "right"), [(9.9, 4.9, True), (10.1, 0.0, False), (0.0, 5.1, False)])
def test_what_is_right(centimetres: float, degrees: float, right: bool) -> None:
    assert relocalisation.is_right({"translation_cm": centimetres, "rotation_deg": degrees}) == right
    assert not relocalisation.is_right({"inliers": 0})


def test_a_frame_is_found_in_a_map_of_the_same_path(room: SyntheticRoom) -> None:
    config: Config = preset("sigma")
    known = known_map.TrueMap(room, room.truth().T_world_camera, config)
    found = known.search(62)
    assert found["found"] and relocalisation.is_right(found) and abs(found["keyframe"] - 62) > known_map.APART


def test_tables_say_what_was_measured(tmp_path: Path) -> None:
    given = {"right_percent": 60.4, "wrong_percent": 1.2, "cpu_ms": {"find": 70.2, "match": 5.0, "pose": 6.0}}
    searched = {"right_percent": 71.0, "false_percent": 0.5, "cpu_ms": 300.2, "frames": 80}
    sequence = {"source": "a", "given": given, "map": searched}
    made = laid_out("relocalisation", {"sequences": [sequence]})
    assert made["Candidate given"].rows == [["a", "60", "1", "70 + 5 + 6"]]
    assert made["Whole map"].rows == [["a", "71", "0.5", "300"]]
