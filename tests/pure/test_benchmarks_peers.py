"""The comparison with other systems: same frames, same score, and no missing pose goes uncounted."""

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmark_results import results
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import ConfigError
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.trajectory import write_trajectory

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.append(str(BENCHMARKS))
peers, record = map(importlib.import_module, ("peers", "record"))
ROOM = "synthetic:frames=6,width=64,height=48"


def run(system: str, source: str, ate_m: float | None, **rest: Any) -> dict[str, Any]:
    return {"system": system, "source": source, "problem": None, "frames": 6, "ate_m": ate_m, **rest}


def test_frames_without_a_pose_are_counted_and_not_scored(tmp_path: Path) -> None:
    source = open_source(ROOM)
    truth = source.truth()
    assert truth is not None
    times, poses = truth.timestamps_s, truth.T_world_camera.copy()
    poses[:, :3, 3] += 1.0  # the rigid fit removes it
    poses[2] = np.nan
    write_trajectory(tmp_path / "other.txt", peers.path_of(times, poses))
    options = peers.Options((ROOM,), paths=(f"Other={ROOM}={tmp_path / 'other.txt'}",))
    (result,) = peers.read_paths(options)
    assert (result["system"], result["frames"], result["without_pose"]) == ("Other", 6, 1)
    assert result["ate_m"] == pytest.approx(0.0, abs=1e-9)


def test_a_path_without_system_or_sequence_is_refused() -> None:
    with pytest.raises(ConfigError, match="SYSTEM=SEQUENCE=FILE"):
        peers.read_paths(peers.Options((ROOM,), paths=("poses.txt",)))


def test_rotations_of_other_systems_are_made_exact() -> None:
    skewed = np.eye(4)
    skewed[0, 1] = 1e-3
    path = peers.path_of(np.zeros(1), skewed[None])
    assert isinstance(path, Trajectory) and len(path) == 1


def test_another_system_gets_the_frames_and_its_failure_is_reported(tmp_path: Path) -> None:
    peers.write_frames(open_source(ROOM), 3, tmp_path)
    color, depth = np.load(tmp_path / "color.npy"), np.load(tmp_path / "depth.npy")
    assert color.shape == (3, 48, 64, 3) and color.dtype == np.uint8
    assert depth.shape == (3, 48, 64) and depth.dtype == np.float32 and depth.max() > 0.5
    assert {"fx", "fy", "cx", "cy", "width", "height"} <= set(json.loads((tmp_path / "camera.json").read_text()))
    absent = peers.Peer("Absent", "absent")
    found = peers.run_peer(absent, "room", ROOM, tmp_path, peers.Options(), Path(sys.executable))
    assert "peer_absent.py" in found["problem"] and "ate_m" not in found


def test_the_table_marks_what_is_quoted_and_where_poses_are_missing() -> None:
    runs = [
        run(peers.OURS, "redkitchen", 0.02, without_pose=0),
        run(peers.OURS, "redkitchen", 0.04, without_pose=0),
        run(peers.OURS, "hololens", 0.3, without_pose=2),
        run("Open3D, dense SLAM", "redkitchen", None, problem="no memory"),
    ]
    measured = {"figures": {"runs": runs, "quoted": list(peers.QUOTED)}}
    table, failed = peers.sections(measured)
    rows = {row[0]: row for row in table.rows}
    assert all(len(row) == len(table.columns) for row in table.rows)
    assert rows[peers.OURS][1].startswith("3.00 ± ") and rows[peers.OURS][3] == "hololens 2 of 6"
    assert rows["RTAB-Map 0.23 †"][1:4] == ["5.20", "10.2", "hololens 63 %"]
    assert failed.rows == [["redkitchen, Open3D, dense SLAM", "no memory"]]


def test_earlier_results_of_other_systems_and_sequences_are_kept(tmp_path: Path) -> None:
    runs = [run(peers.OURS, name, 0.02) for name in ("redkitchen", "desk")] + [run("ORB-SLAM3", "desk", 0.01)]
    options = peers.Options(out=tmp_path)
    with pytest.raises(ConfigError, match="no results 'peers'"):
        peers.kept_rows(options, set())
    record.write(results("peers", {"runs": runs, "quoted": []}), tmp_path)
    kept = peers.kept_rows(options, {(peers.OURS, "desk")})
    assert [(row["system"], row["source"]) for row in kept] == [(peers.OURS, "redkitchen"), ("ORB-SLAM3", "desk")]
    assert all(row["commit"] == "0123456789ab" for row in kept)
    (table,) = peers.sections({"figures": {"runs": kept, "quoted": []}})
    assert table.note.endswith("of commits 012345678.")


def test_a_system_that_finds_no_pose_has_no_error_and_its_frames_are_counted() -> None:
    nothing = peers.path_of(np.zeros(6), np.full((6, 4, 4), np.nan))
    found = peers.score(nothing, open_source(ROOM), None)
    assert found == {"frames": 6, "without_pose": 6, "ate_m": None}
    runs = [run("ORB-SLAM3", "desk", None, without_pose=6), run("ours", "desk", 0.01), run("ours", "redkitchen", 0.02)]
    (table,) = peers.sections({"figures": {"runs": runs, "quoted": []}})
    assert list(table.columns) == ["system", "redkitchen", "desk", "frames without a pose"]
    assert table.rows == [["ORB-SLAM3", "–", "–", "desk 6 of 6"], ["ours", "2", "1", "–"]]
