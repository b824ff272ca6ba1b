"""SLAM on two clocks: laws that hold for every interleaving of tracking and the work on the map."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command_line import exit_code
from constants import changed
from schedules import AtOnce, Drawn, Late
from sigmasplat.config import Config, RealTimeConfig
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.data.submap import MemoryStore
from sigmasplat.data.trajectory import LOST, RELOCALISED
from sigmasplat.errors import RunError
from sigmasplat.plugins.evaluation.metrics.trajectory import ate
from sigmasplat.realtime.system import MappingThread, RealTime
from sigmasplat.run.resume import restore, state_of
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.system.slam import Slam
from small_room import SMALL, frame_at, frames, walk

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

FRAMES = 40
QUICK = SMALL | {
    "mapping.first_iterations": "12", "mapping.iterations": "6", "submaps.frames": "12", "final.iterations": "0",
    "registration.iterations": "2", "loops.min_interval": "1",
}  # fmt: skip


def config(spare_iterations: int = 8, keyframe_deg: float = 5.0, **changes: str) -> Config:
    made = override(preset("sigma"), QUICK | {name.replace("__", "."): value for name, value in changes.items()})
    return replace(made, realtime=changed(made.realtime, spare_iterations=spare_iterations, keyframe_deg=keyframe_deg))


def error_m(system: RealTime) -> float:
    truth, path = walk().truth(), system.trajectory()
    assert truth is not None
    return float(ate(path, truth).rmse_m)


FITTED = {"tracking__fit_depth": "true", "mapping__divided": "false"}
"""Depth is fitted to the map, and a snapshot of the map does not contain the steps that keyframes are owed."""


@pytest.mark.parametrize("more", [{}, pytest.param(FITTED, marks=pytest.mark.slow)], ids=["measured", "predicted"])
def test_the_results_are_those_of_a_recording_if_mapping_always_ends_before_the_next_frame(more: dict) -> None:
    same = config(spare_iterations=0, keyframe_deg=0.0, **more)
    usual, system = Slam(same), RealTime(Slam(same), AtOnce())
    for frame in frames(FRAMES):
        usual.step(frame)
        system.step(frame)
    system.settle()
    assert len(usual.atlas.anchors) > 2
    assert np.array_equal(usual.trajectory().T_world_camera, system.trajectory().T_world_camera)
    assert np.array_equal(usual.field.params.numpy(), system.field.params.numpy())
    assert usual.keyframe_indices == system.slam.keyframe_indices


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
def test_every_interleaving_gives_every_frame_a_pose_and_leaves_snapshots_whole(seed: int) -> None:
    system = RealTime(Slam(config()), Drawn(seed, most=10 + 30 * (seed % 2)))
    kept = []
    for number, frame in enumerate(frames(FRAMES)):
        step = system.step(frame)
        assert step.index == number and np.isfinite(step.T_world_camera).all() and not step.lost
        snapshot = system.snapshot
        if snapshot is not None:
            kept.append((snapshot, snapshot.params.clone(), snapshot.keyframe.reference.T_camera_world.copy()))
    system.settle()
    for snapshot, params, T_camera_submap in kept:
        assert np.array_equal(snapshot.params.numpy(), params.numpy())
        assert np.array_equal(snapshot.keyframe.reference.T_camera_world, T_camera_submap)
    slam = system.slam
    assert [step.index for step in slam.steps] == list(range(FRAMES)) and len(slam.atlas.places) == FRAMES
    assert len(slam.atlas.anchors) > 1 and slam.keyframe_indices == sorted(set(slam.keyframe_indices))
    assert error_m(system) < 0.03


def test_the_same_interleaving_gives_the_same_bytes() -> None:
    paths = []
    for _ in range(2):
        system = RealTime(Slam(config()), Drawn(5))
        for frame in frames(20):
            system.step(frame)
        system.settle()
        paths.append(system.trajectory().T_world_camera)
    assert np.array_equal(*paths)


def covered(frame: Frame) -> Frame:
    return replace(frame, color=np.zeros_like(frame.color), depth_m=np.zeros_like(frame.depth_m))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_lost_camera_is_reported_at_once_and_found_again(seed: int) -> None:
    """Frames go on while the whole map is searched. The camera returns to a place of a finished submap."""
    seen = frames(80)[::2]
    path = [*seen, *[covered(frame) for frame in seen[:3]], *[seen[4]] * 40]
    system, states = RealTime(Slam(config()), Drawn(seed, most=60)), []
    for number, frame in enumerate(path):
        states.append(system.step(replace(frame, index=number, timestamp_s=number / 30)).state)
    system.settle()
    assert LOST in states[40:43] and RELOCALISED in states[43:]
    poses = system.trajectory().T_world_camera
    assert np.abs(poses[-1, :3, 3] - poses[4, :3, 3]).max() < 0.03
    assert np.isfinite(poses).all()


def test_a_search_does_not_move_a_camera_that_is_tracked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """One frame shows another place. While the map is searched for it, the camera goes on, and makes keyframes."""
    monkeypatch.setattr(RealTimeConfig, "waiting_most", 2)
    path, schedule = [*range(0, 40, 2), 2, *range(40, 80, 2)], Late(10**6)
    system, states = RealTime(Slam(config(keyframe_deg=0.0)), schedule), list[str]()
    for number, i in enumerate(path):
        schedule.slices = {20: 1}.get(number, 0 if 20 < number < 30 else 10**6)
        states.append(system.step(replace(frame_at(i), index=number, timestamp_s=number / 30)).state)
    system.settle()
    assert states[20] == LOST and states[22:] == ["tracked"] * 19
    T = walk().truth().T_world_camera[path]
    off_m = np.linalg.norm((system.trajectory().T_world_camera - se3.inverse(T[0]) @ T)[:, :3, 3], axis=1)
    assert off_m[system.valid()].max() < 0.03
    assert system.slam.keyframe_indices[-1] > 35


def test_a_keyframe_is_a_matter_of_motion() -> None:
    """A camera at rest makes no keyframe after the first one."""
    system = RealTime(Slam(config()), AtOnce())
    still = [replace(frames(1)[0], index=i, timestamp_s=i / 30) for i in range(15)]
    assert [system.step(frame).is_keyframe for frame in still] == [True] + [False] * 14


def test_a_fast_camera_makes_no_more_keyframes_than_in_a_recording() -> None:
    """Each keyframe adds an error to the path."""
    system = RealTime(Slam(config(keyframe_deg=0.5, mapping__every="4", mapping__overlap_below="0")), AtOnce())
    assert [step.index for step in map(system.step, frames(14)) if step.is_keyframe] == [0, 4, 8, 12]


def test_the_first_map_is_left_unfinished_at_a_cut_if_a_keyframe_waits() -> None:
    """Otherwise all later keyframes wait for it, and none of them is fitted."""
    often = config(mapping__first_iterations="400", mapping__every="4", keyframe_deg=0.5)
    system = RealTime(Slam(often), Late(slices=6))
    steps = [system.step(frame) for frame in frames(50)]
    assert max(step.tracking.get("waiting", 0) for step in steps) <= 3
    system.settle()
    assert len(system.slam.atlas.anchors) > 2


def test_a_map_that_falls_behind_is_still_fitted_and_cut() -> None:
    """If every keyframe has another one behind it, and all but the last were only added, one submap would hold all."""
    often = config(mapping__every="2", keyframe_deg=0.5)
    system = RealTime(Slam(often), Late(slices=0))
    steps = [system.step(frame) for frame in frames(40)]
    system.settle()
    assert sum(step.is_keyframe for step in steps) > 12
    store = system.slam.store
    begins = [store.load(i).frames[0] for i in range(len(store))]
    assert begins == [0, 12, 24], "a submap ends where it would in a recording"
    assert max(len(store.load(i).frames) for i in range(len(store))) <= 12


def test_a_keyframe_is_aligned_again_when_the_weights_of_the_one_before_it_are_known() -> None:
    """Else the path would be that of an alignment without weights."""
    same = config(spare_iterations=0, mapping__every="4", keyframe_deg=0.0, submaps__frames="1000")
    usual, late = Slam(same), RealTime(Slam(same), Late(slices=3))
    for frame in frames(FRAMES):
        usual.step(frame)
        late.step(frame)
    late.settle()
    assert usual.keyframe_indices == late.slam.keyframe_indices
    assert any(step.tracking["waiting"] > 1 for step in late.slam.steps if step.is_keyframe)
    apart = (
        late.trajectory().T_world_camera[usual.keyframe_indices]
        - usual.trajectory().T_world_camera[usual.keyframe_indices]
    )
    assert np.linalg.norm(apart[:, :3, 3], axis=1).max() < 1e-4, "without it 2.4e-4"


def test_too_many_waiting_keyframes_are_refused_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    class Never(AtOnce):
        def wake(self) -> None:
            pass

    often = config(keyframe_deg=0.5, mapping__every="1")
    monkeypatch.setattr(type(often.realtime), "waiting_most", 3)
    system = RealTime(Slam(often), Never())
    steps = [system.step(frame) for frame in frames(20)]
    assert sum(step.is_keyframe for step in steps) == 3 and system.keyframes_refused > 5
    assert max(step.tracking["waiting"] for step in steps) == 3
    system.settle()
    assert len(system.slam.keyframe_indices) == 3


@pytest.mark.parametrize("should_stop", [0, 8])
def test_a_frame_in_a_hurry_tries_no_further_guesses_and_tracking_recovers_afterwards(should_stop: int) -> None:
    """After a jump the first guess fails. While frames wait, it is the only one; then features find the camera."""
    seen, lost = frames(80), list[bool]()
    system = RealTime(Slam(config(recovery__relocalise="off")), AtOnce(), should_stop=lambda: len(lost) < should_stop)
    for number, frame in enumerate([*seen[40:46], *seen[58:62]]):
        lost.append(system.step(replace(frame, index=number, timestamp_s=number / 30)).lost)
    system.settle()
    assert np.isfinite(system.trajectory().T_world_camera).all()
    assert lost == [False] * 6 + [bool(should_stop)] * 2 + [False] * 2


# ---- the thread ----


@pytest.fixture
def frantic() -> Iterator[None]:
    """Threads change as often as possible."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(usual)


def test_a_thread_maps_all_keyframes_before_the_results_are_read(frantic: None) -> None:
    system = RealTime(Slam(config()))
    for frame in frames(FRAMES):
        assert np.isfinite(system.step(frame).T_world_camera).all()
    seen: list[int] = []
    system.between_frames(lambda: seen.append(len(system.slam.steps)))
    system.settle()
    assert seen == [FRAMES] and len(system.trajectory()) == FRAMES
    assert error_m(system) < 0.05
    assert len(system.slam.mapper.field) > 100


class FullStore(MemoryStore):
    def save(self, *args: object) -> None:
        raise RunError("no space left")


@pytest.mark.parametrize("schedule", [AtOnce, MappingThread])
def test_what_mapping_raises_reaches_the_caller(schedule: type) -> None:
    system = RealTime(Slam(config(), FullStore()), schedule())
    with pytest.raises(RunError, match="no space left"):
        for frame in frames(FRAMES):
            system.step(frame)
        system.settle()
    system.settle()  # has nothing left to raise
    assert len(system.trajectory()) > 0


def test_what_fails_at_the_start_of_the_mapping_thread_reaches_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(count: int) -> int:
        time.sleep(0.2)  # `settle` is called before it fails
        raise MemoryError("no thread can be made")

    monkeypatch.setattr("sigmasplat.realtime.system.set_kernel_threads", fail)
    schedule = MappingThread()
    schedule.start(iter([False]))
    with pytest.raises(MemoryError, match="no thread"):
        schedule.settle()
    schedule.stop()


# ---- runs ----


def test_a_state_that_was_saved_beside_the_frames_belongs_to_one_frame() -> None:
    system, states = RealTime(Slam(config()), Drawn(1)), []
    for number, frame in enumerate(frames(30)):
        system.step(frame)
        if number == 20:
            system.save(lambda: states.append(state_of(system.slam)))
    system.settle()
    assert len(states) == 1
    resumed = Slam(config(), system.slam.store)
    resumed.prepare(system.slam.view.camera)
    saved = states[0]
    restore(resumed, saved)
    assert len(resumed.steps) >= 21 and np.isfinite(resumed.tracker.previous).all()


ROOM = "synthetic:frames=200,width=80,height=60"
SETTINGS = [
    word
    for setting in ("input.width=80", "mapping.first_iterations=5", "mapping.iterations=3", "final.iterations=5",
                    "submaps.frames=10", "registration.iterations=2")
    for word in ("--set", setting)
]  # fmt: skip


def test_a_recording_in_real_time_has_latencies_and_counts_drops(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert exit_code("run", ROOM, "--realtime", "--no-eval", "--limit", "30", "--out", str(out), *SETTINGS) == 0
    run = RunFolder.open(out)
    log, facts = run.read_log(), run.facts()
    assert facts["status"] == "complete" and facts["realtime"] and facts["dropped"] == 30 - len(log)
    assert all(line["seconds"]["latency"] > 0 for line in log)
    assert len(run.read_trajectory()) == len(log) - sum(line["lost"] for line in log)


def started(out: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "sigmasplat.cli", "run", ROOM, "--realtime", "--no-eval", "--limit", "90"]
    command += ["--save-every", "0.01", "--out", str(out), *SETTINGS]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ)
    deadline_s = time.monotonic() + 90
    while not (out / "state.safetensors").exists() or len(RunFolder(out).read_log()) < 12:
        assert process.poll() is None and time.monotonic() < deadline_s
        time.sleep(0.01)
    return process


@pytest.mark.slow
def test_ctrl_c_leaves_a_valid_run_with_all_frames_mapped(tmp_path: Path) -> None:
    process = started(tmp_path / "run")
    process.send_signal(signal.SIGINT)
    said, errors = process.communicate(timeout=90)
    assert process.returncode == 130 and "Traceback" not in said + errors
    run = RunFolder.open(tmp_path / "run")
    log = run.read_log()
    assert run.facts()["status"] == "interrupted" and len(log) == len(run.read_checkpoint()[0]["frame_submap"])
    assert exit_code("resume", str(tmp_path / "run"), "--no-eval") == 0


@pytest.mark.slow
def test_a_killed_run_resumes(tmp_path: Path) -> None:
    process = started(tmp_path / "run")
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=90)
    assert exit_code("resume", str(tmp_path / "run"), "--no-eval") == 0
    run = RunFolder.open(tmp_path / "run")
    assert run.facts()["status"] == "complete" and len(run.read_map()) > 100
    assert len(run.read_checkpoint()[0]["frame_submap"]) == len(run.read_log())
