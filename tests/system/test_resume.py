"""A stopped or killed run resumes where it left off, and ends with the same bytes as an uninterrupted run."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import make_dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from command_line import exit_code
from sigmasplat.commands.run import resume_line
from sigmasplat.config import Config, LoopConfig
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data.poses import Column, KeyframePoses
from sigmasplat.errors import RunError
from sigmasplat.plugins.sources import open_source
from sigmasplat.run.resume import CLASSES, fixed, restore, state_of
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.run_folder.state import read_state, write_state
from sigmasplat.run_folder.submaps import DiskStore
from sigmasplat.system.slam import Slam

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

ROOM = "synthetic:frames=120,width=80,height=60,noise=1"
FRAMES = 24
SETTINGS = {
    "input.width": "80", "input.limit": str(FRAMES), "mapping.first_iterations": "8", "mapping.iterations": "4",
    "mapping.every": "3", "submaps.frames": "9", "final.iterations": "6", "registration.iterations": "2",
}  # fmt: skip
SAME = ("trajectory.txt", "map.ply", "loops.json", "checkpoint.safetensors")


def arguments(out: Path, name: str) -> list[str]:
    settings = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
    return ["run", ROOM, "--preset", name, "--out", str(out), "--no-eval", "--save-every", "0.001", *settings]


def killed(out: Path, name: str, after: int, *more: str) -> int:
    """Run in a separate process, kill it when `after` frames are logged, and return how many were logged."""
    process = subprocess.Popen(
        [sys.executable, "-m", "sigmasplat.cli", *arguments(out, name), *more],
        env=os.environ,
        stdout=subprocess.DEVNULL,
    )
    log, deadline_s = out / "log.jsonl", time.monotonic() + 90
    while not log.exists() or log.read_text().count("\n") < after:
        assert process.poll() is None and time.monotonic() < deadline_s
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    return log.read_text().count("\n")


def without_times(run: Path) -> list[dict]:
    return [{key: value for key, value in line.items() if key != "seconds"} for line in RunFolder(run).read_log()]


@pytest.mark.slow
def test_a_resumed_run_with_probe_views_gives_the_same_bytes(tmp_path: Path) -> None:
    probes = ("--set", "uncertainty.probes=2")
    assert exit_code(*arguments(tmp_path / "whole", "sigma"), *probes) == 0
    assert killed(tmp_path / "cut", "sigma", 13, *probes) < FRAMES
    assert exit_code("resume", str(tmp_path / "cut"), "--no-eval") == 0
    for file in (*SAME, "uncertainty.json", "uncertainty.safetensors"):
        assert (tmp_path / "cut" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes(), file
    found = RunFolder(tmp_path / "cut").read_uncertainty()
    assert found is not None and found.probes > 0


@pytest.mark.slow
def test_a_run_killed_in_its_final_map_gives_the_same_bytes(tmp_path: Path) -> None:
    """The second start makes the final map again, here with view-dependent colours and poses that move."""
    steps = ["final.iterations=400", "final.sh_degree=2"]
    more = [word for step in steps for word in ("--set", step)]
    assert exit_code(*arguments(tmp_path / "whole", "sigma"), *more) == 0
    run = RunFolder(tmp_path / "cut")
    assert killed(run.path, "sigma", FRAMES, *more) == FRAMES
    assert not (run.path / "map.ply").exists()
    assert exit_code("resume", str(run.path), "--no-eval") == 0
    for file in SAME:
        assert (run.path / file).read_bytes() == (tmp_path / "whole" / file).read_bytes(), file


@pytest.mark.parametrize("name, after", [("sigma", 13), pytest.param("cgslam-fast", 7, marks=pytest.mark.slow)])
def test_a_resumed_run_gives_the_same_bytes(tmp_path: Path, name: str, after: int) -> None:
    assert exit_code(*arguments(tmp_path / "whole", name)) == 0
    assert killed(tmp_path / "cut", name, after) < FRAMES
    assert RunFolder(tmp_path / "cut").facts()["status"] == "running"
    assert exit_code("resume", str(tmp_path / "cut"), "--no-eval") == 0
    for file in SAME:
        assert (tmp_path / "cut" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes(), file
    assert without_times(tmp_path / "cut") == without_times(tmp_path / "whole")
    facts = RunFolder(tmp_path / "cut").facts()
    assert facts["status"] == "complete" and facts["wall_s"] > 0
    assert not (tmp_path / "cut/state.safetensors").exists()


def tiny() -> Config:
    return override(preset("sigma"), SETTINGS)


@pytest.mark.parametrize("fit_depth", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_slam_can_resume_from_every_frame(tmp_path: Path, fit_depth: bool) -> None:
    """Also directly after a new submap has started, when it has one keyframe."""
    source, config = open_source(ROOM, tiny().input), tiny().changed(tracking={"fit_depth": fit_depth})
    whole = Slam(config)
    seen = []
    for frame in source:
        whole.step(frame)
        write_state(tmp_path / f"{frame.index}.st", state_of(whole), CLASSES, fixed(whole))
        seen.append(whole.mapper.field.params.clone())
    for begun in (0, 4, 8, 9, 15):
        slam = Slam(config, whole.store)  # finished submaps never change; the store has more than at that frame
        slam.prepare(whole.view.camera)
        restore(slam, read_state(tmp_path / f"{begun}.st", CLASSES, fixed(slam)))
        assert torch.equal(slam.mapper.field.params, seen[begun])
        if len(slam.atlas.anchors) == len(whole.atlas.anchors):  # else the store has later submaps too
            for frame in list(source)[begun + 1 :]:
                slam.step(frame)
            assert torch.equal(slam.mapper.field.params, seen[-1])
            assert np.array_equal(slam.trajectory().T_world_camera, whole.trajectory().T_world_camera)


def test_the_resume_line_has_the_frame() -> None:
    assert resume_line(FRAMES - 1, FRAMES) == "resuming at frame 23 of 24"
    assert resume_line(FRAMES, FRAMES) == "all 24 frames are done: making the final map"


def test_runs_that_cannot_be_resumed_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert exit_code(*arguments(out, "sigma"), "--set", "input.limit=2") == 0
    assert exit_code("resume", str(out)) == 2
    assert "is complete" in capsys.readouterr().err
    RunFolder(out).note(status="interrupted")
    assert exit_code("resume", str(out)) == 2
    assert "nothing to resume" in capsys.readouterr().err
    (out / "state.safetensors").write_bytes(b"damaged")
    assert exit_code("resume", str(out)) == 2
    assert "is damaged" in capsys.readouterr().err


def test_a_state_of_classes_with_other_fields_is_of_another_version(tmp_path: Path) -> None:
    before = make_dataclass("Facts", [("a", int)])
    after = make_dataclass("Facts", [("a", int), ("b", int)])
    write_state(tmp_path / "s", before(1), (before,), {})
    assert read_state(tmp_path / "s", (before,), {}) == before(1)
    with pytest.raises(RunError, match="another version"):
        read_state(tmp_path / "s", (after,), {})


def test_a_state_contains_plain_data_only(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="cannot hold"):
        write_state(tmp_path / "s", {"a": object()}, (), {})
    shared = np.arange(100.0)
    tree = {"a": [1, None, "x", float("inf")], "b": (shared, shared), 3: torch.ones(2, 2, dtype=torch.float64)}
    write_state(tmp_path / "s", tree, (), {})
    back = read_state(tmp_path / "s", (), {})
    assert back["a"] == tree["a"] and np.array_equal(back["b"][0], shared) and torch.equal(back[3], tree[3])
    assert np.shares_memory(*back["b"]), "shared arrays stay shared"
    with pytest.raises(RunError, match="nothing to resume"):
        read_state(tmp_path / "none", (), {})


@pytest.mark.parametrize("place", range(0, 100, 7))
def test_a_state_with_a_changed_byte_is_refused(place: int, tmp_path: Path) -> None:
    """The arrays are in the file itself, or in its text: any changed byte is found, whatever value it gives."""
    poses = KeyframePoses()
    poses.rows.extend(np.zeros((9, *poses.rows.values.shape[1:]), poses.rows.values.dtype))
    classes = (KeyframePoses, Column)
    write_state(tmp_path / "s", {"poses": poses, "index": 3}, classes, {})
    assert read_state(tmp_path / "s", classes, {})["index"] == 3
    content = bytearray((tmp_path / "s").read_bytes())
    content[-1 - place * len(content) // 120] ^= 1
    (tmp_path / "s").write_bytes(content)
    with pytest.raises(RunError, match=r"damaged|another version"):
        read_state(tmp_path / "s", classes, {})


@pytest.mark.parametrize("slices, waiting", [(2, 1), pytest.param(1, 2, marks=pytest.mark.slow)])
def test_a_search_for_loops_that_is_divided_over_frames_resumes_and_finds_what_a_whole_one_finds(
    slices: int, waiting: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each frame that is not a keyframe makes some slices; the state is saved when some are made. With one slice, the
    next submap ends before the search does, and its own search waits."""
    monkeypatch.setattr(LoopConfig, "near_deg", 180.0)
    monkeypatch.setattr("sigmasplat.slam.main_loop.SLICES_PER_FRAME", slices)
    loops, final = {"near_m": 10.0}, {"iterations": 0}
    config = tiny().changed(input={"limit": 36}, submaps={"frames": 6}, loops=loops, final=final)
    frames = list(open_source(ROOM, config.input))
    slam, whole = Slam(config, DiskStore(tmp_path / "slam")), Slam(config)
    saved, reported = tmp_path / "saved.st", list[int]()
    for frame in frames:
        with monkeypatch.context() as patch:
            patch.setattr("sigmasplat.slam.main_loop.SLICES_PER_FRAME", 10**6)
            at_once = whole.step(frame)
        step = slam.step(frame)
        assert at_once.is_keyframe or not whole.closer.pending
        reported += [step.index] * len(step.loops)
        pending = slam.closer.pending
        if not saved.exists() and len(pending) >= waiting and pending[0].slices > 2:
            write_state(saved, state_of(slam), CLASSES, fixed(slam))
    assert reported
    resumed = Slam(config, DiskStore(tmp_path / "slam"))
    resumed.prepare(slam.view.camera)
    tree = read_state(saved, CLASSES, fixed(resumed))
    resumed.store.truncate(tree["submaps"])
    restore(resumed, tree)
    assert len(resumed.closer.pending) >= waiting and len(resumed.steps) < reported[0]
    for frame in frames[len(resumed.steps) :]:
        resumed.step(frame)
    assert np.array_equal(resumed.trajectory().T_world_camera, slam.trajectory().T_world_camera)
    assert [loop.record() for loop in resumed.loops] == [loop.record() for loop in slam.loops]
    for each in (resumed, whole):
        each.finish()
    tried = [[(loop.query, loop.database, loop.accepted) for loop in each.loops] for each in (resumed, whole)]
    assert tried[0] == tried[1] and any(accepted for *_, accepted in tried[0])
