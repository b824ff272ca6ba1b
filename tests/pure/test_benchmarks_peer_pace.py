"""benchmarks/peer_pace.py: times of the right frames, no rate of a system that waits, and failures in one line."""

import importlib
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmark_results import laid_out
from sigmasplat.errors import SigmaSplatError

peer_clock, peer_pace, peers = map(importlib.import_module, ("peer_clock", "peer_pace", "peers"))
ROOM = "synthetic:frames=3,width=64,height=48"
SCORE = {"frames": 4, "without_pose": 0, "ate_m": 0.02}


def step(index: int, **seconds: float) -> dict[str, Any]:
    return {"timestamp_s": 0.6 * index, "seconds": seconds}


def test_the_clock_counts_calls_and_leaves_waiting_out(tmp_path: Path) -> None:
    clock = peer_clock.Clock()
    for _ in range(2):
        with clock.call():
            time.sleep(0.01)
        clock.wait(0.05)
    clock.wait(-1.0)
    clock.write(tmp_path)
    calls_s, totals = np.load(tmp_path / "seconds.npy"), json.loads((tmp_path / "clock.json").read_text())
    assert calls_s.shape == (2,) and (calls_s >= 0.01).all()
    assert totals["waited_s"] >= 0.1 and totals["wall_s"] >= calls_s.sum() + totals["waited_s"]
    assert totals["later_wall_s"] <= totals["wall_s"] - calls_s[0]
    assert 0.0 <= totals["later_processor_s"] < totals["later_wall_s"]


def test_a_call_that_fails_is_timed() -> None:
    clock = peer_clock.Clock()
    with pytest.raises(RuntimeError), clock.call():
        raise RuntimeError("too few correspondences")
    assert len(clock.calls_s) == 1


def test_the_first_second_does_not_count_unless_there_is_nothing_else() -> None:
    assert peer_pace.times_of([9.0, 9.0, 0.2, 0.4], [5.0, 5.6, 6.2, 6.8])["median_ms"] == pytest.approx(300.0)
    assert peer_pace.times_of([9.0, 0.1, 0.3], [0.0, 0.1, 0.2])["median_ms"] == pytest.approx(200.0)


def test_a_run_in_turn_gives_its_tracking_too() -> None:
    log = [step(0, total=2.0), *(step(i, total=0.2, prepare=0.01, track=0.03) for i in range(1, 4))]
    whole, tracking = peer_pace.ours_of(log, {"wall_s": 4.0, "finish_s": 9.0}, 3.0, 4.5, SCORE)
    assert (whole["system"], tracking["system"]) == (peer_pace.IN_TURN, peer_pace.TRACKING)
    assert whole["median_ms"] == pytest.approx(200.0) and tracking["median_ms"] == pytest.approx(40.0)
    assert whole["frames_per_s"] == pytest.approx(1.0) and whole["final_s"] == 9.0
    assert whole["cores"] == pytest.approx(1.5) and whole["processor_ms"] == pytest.approx(1500.0)
    assert tracking["frames_per_s"] == pytest.approx(4 / 0.12) and "cores" not in tracking


def test_in_real_time_the_latency_is_the_time_of_a_frame() -> None:
    log = [step(i, total=0.2, latency=0.01 * i) for i in range(4)]
    facts = {"wall_s": 2.0, "finish_s": 1.0, "realtime": True, "dropped": 1}
    (found,) = peer_pace.ours_of(log, facts, 2.0, 1.0, SCORE)
    assert found["system"] == peer_pace.REALTIME and found["median_ms"] == pytest.approx(25.0)
    assert found["frames_per_s"] == pytest.approx(2.0) and found["dropped"] == 1


@pytest.mark.parametrize(("name", "rate"), [("Open3D, dense SLAM", 1.5), (peer_pace.SLOW_PEER, None)])
def test_half_a_second_between_frames_gives_no_rate(name: str, rate: float | None) -> None:
    peer = next(peer for peer in peer_pace.PEERS if peer.name == name)
    totals = {"wall_s": 2.0, "waited_s": 1.0, "later_wall_s": 1.5, "later_processor_s": 1.0}
    found = peer_pace.peer_figures(peer, [0.0, 1.1, 1.2], [5.0, 0.1, 0.1], totals)
    assert found["median_ms"] == pytest.approx(100.0) and found["processor_ms"] == pytest.approx(500.0)
    assert found["frames_per_s"] == rate and (found["cores"] is None) == (rate is None)


def test_the_table_has_medians_of_rounds_and_marks_what_is_quoted() -> None:
    usual = {"source": "redkitchen", "problem": None, "median_ms": 8.0, "p99_ms": 200.0, "frames_per_s": 16.0}
    ours = {**usual, **SCORE, "system": peer_pace.IN_TURN, "cores": 1.5, "processor_ms": 90.0, "final_s": 30.0}
    slow = {**usual, **SCORE, "system": peer_pace.SLOW_PEER, "frames_per_s": None, "cores": None, "processor_ms": 50.0}
    runs = [slow, ours, ours | {"median_ms": 10.0}, {**usual, "system": peer_pace.TRACKING}]
    (table,) = laid_out("peer_pace", {"runs": runs, "quoted": peer_pace.QUOTED[:1]}).values()
    rows = {row[0]: row[1:] for row in table.rows}
    assert list(rows) == [peer_pace.IN_TURN, peer_pace.TRACKING, peer_pace.SLOW_PEER, "RTAB-Map †"]
    assert rows[peer_pace.IN_TURN] == ["9.00", "200", "16.0", "1.50", "90.0", "0 of 4", "2.00", "30.0", "splats"]
    assert rows[peer_pace.TRACKING][3:] == ["–", "–", "–", "–", "–", "none"]
    assert rows[peer_pace.SLOW_PEER][2:4] == ["–", "–"]
    assert rows["RTAB-Map †"][2:4] == ["15–23", "1"] and "† Not measured" in table.note


def test_other_systems_that_fail_give_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(peer_pace, "PEERS", (peers.Peer("Absent", "absent"),))
    monkeypatch.setattr(peer_pace, "pythons_of", lambda options: {"absent": options.open3d})
    for python, said in ((Path(sys.executable), "Absent: "), (tmp_path / "nowhere", "nowhere")):
        options = peer_pace.Options((ROOM,), open3d=python, out=tmp_path / "out")
        assert peer_pace.main(options) == 2
        error = capsys.readouterr().err
        assert error.startswith("peer_pace.py: ") and said in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_results_are_written_without_the_paths_of_other_systems(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(peer_pace, "measure", lambda options: {"runs": [], "quoted": []})
    assert peer_pace.main(peer_pace.Options((ROOM,), open3d=tmp_path / "python", quick=True, out=tmp_path)) == 0
    assert not list(tmp_path.iterdir())
    assert peer_pace.main(peer_pace.Options((ROOM,), open3d=tmp_path / "python", out=tmp_path)) == 0
    (written,) = tmp_path.glob("peer-pace-*.json")
    config = json.loads(written.read_text())["config"]
    assert (config["open3d"], config["orbslam3"], config["vocabulary"]) == (True, False, False)


def test_one_frame_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert peer_pace.main(peer_pace.Options((ROOM,), limit=1, out=tmp_path)) == 2
    assert capsys.readouterr().err == "peer_pace.py: --limit 1: at least two frames are needed\n"


WATCHED = """
import pathlib, sys, time

def work(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass

work(0.5)
for i in range(4):
    with (pathlib.Path(sys.argv[1]) / "log.jsonl").open("a") as file:
        print("{}", file=file)
    work(0.1 * (i < 3))
time.sleep(0.3)
"""


def test_a_run_is_watched_from_its_first_frame_to_its_last(tmp_path: Path) -> None:
    wall_s, used_s = peer_pace.watched(
        [sys.executable, "-c", WATCHED, str(tmp_path)], tmp_path, tmp_path / "output.txt"
    )
    assert 0.0 < used_s <= 0.4 and wall_s > 0.0


@pytest.mark.parametrize(("program", "said"), [("exit('no camera')", "no camera"), ("", "too short")])
def test_a_run_that_fails_or_is_too_short_says_so(tmp_path: Path, program: str, said: str) -> None:
    with pytest.raises(SigmaSplatError, match=said):
        peer_pace.watched([sys.executable, "-c", program], tmp_path, tmp_path / "output.txt")
