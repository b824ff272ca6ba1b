"""Full disks, exhausted memory and signals: one line, and a run folder that says how the run ended."""

import errno
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from command_line import exit_code
from run_process import PATIENCE_S, QUICK, ROOM, files_of_at_most, lines, running, wait_for
from sigmasplat.files.tensors import write_tensors
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.system.slam import Slam

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")


def run_of(out: Path, frames: int, *more: str) -> list[str]:
    """Return the arguments of a short run."""
    settings = [word for setting in (*QUICK, *more) for word in ("--set", setting)]
    return ["run", ROOM, "--out", str(out), "--limit", str(frames), "--no-eval", *settings]


def limited(kind: int, size: int, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run a command in a process with a limit on memory or on the size of files."""
    return subprocess.run(
        [sys.executable, "-m", "sigmasplat.cli", *arguments], capture_output=True, text=True, timeout=PATIENCE_S,
        env=os.environ, preexec_fn=lambda: resource.setrlimit(kind, (size, size)),
    )  # fmt: skip


def refusal(text: str) -> str:
    """Return the last line of standard error, which must be the only one of an error."""
    assert "Traceback" not in text, text
    line = text.strip().splitlines()[-1]
    assert line.startswith("sigmasplat: "), text
    return line


def test_results_that_cannot_be_written_make_the_run_failed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    with files_of_at_most(30_000):
        assert exit_code(*run_of(out, 3)) == 2
    assert "cannot write" in refusal(capsys.readouterr().err)
    assert RunFolder(out).facts()["status"] == "failed"
    assert not [path for path in out.rglob("*") if path.name.startswith(".")]


OUT_OF_MEMORY = [
    MemoryError(),
    np.exceptions.AxisError("not memory"),
    RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 8000000000 bytes"),
    RuntimeError("std::bad_alloc"),
    OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
]


@pytest.mark.parametrize("place", ["frame", "map"])
@pytest.mark.parametrize("problem", OUT_OF_MEMORY, ids=lambda problem: f"{type(problem).__name__} {problem}"[:30])
def test_exhausted_memory_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], problem: Exception, place: str
) -> None:
    step: Callable[..., Any] = Slam.step

    def exhausted(*arguments: Any) -> Any:
        if place == "map" or arguments[1].index == 2:
            raise problem
        return step(*arguments)

    if place == "map":
        monkeypatch.setattr(RunFolder, "write_map", exhausted)
    else:
        monkeypatch.setattr(Slam, "step", exhausted)
    out = tmp_path / "run"
    if isinstance(problem, ValueError):  # an error in the program is no lack of memory
        with pytest.raises(ValueError, match="not memory"):
            exit_code(*run_of(out, 4))
    else:
        assert exit_code(*run_of(out, 4)) == 2
        assert "out of memory" in refusal(capsys.readouterr().err)
    run = RunFolder(out)
    assert run.facts()["status"] == "failed" and len(run.read_log()) == len(run.read_trajectory()) > 1


def test_too_little_address_space_is_refused_at_once(tmp_path: Path) -> None:
    ended = limited(resource.RLIMIT_AS, 700_000_000, *run_of(tmp_path / "run", 2))
    assert ended.returncode == 2 and "700 MB" in refusal(ended.stderr)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_sigterm_and_sighup_keep_the_last_frame(tmp_path: Path, number: signal.Signals) -> None:
    out = tmp_path / "run"
    with running(out) as process:
        wait_for(process, lambda: lines(out) >= 3)
        process.send_signal(number)
        said, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, errors
    assert "Traceback" not in said + errors and "interrupted after" in said
    run = RunFolder.open(out)
    assert run.facts()["status"] == "interrupted" and run.state.is_file()
    assert 3 <= len(run.read_log()) == len(run.read_trajectory()) < 200 and len(run.read_map())


@pytest.mark.slow
def test_an_ignored_sighup_stays_ignored(tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = ["nohup", sys.executable, "-m", "sigmasplat.cli", *run_of(out, 8, "final.iterations=2")]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ
    ) as process:
        deadline_s = time.monotonic() + PATIENCE_S
        while lines(out) < 2:
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        process.send_signal(signal.SIGHUP)
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    assert RunFolder(out).facts()["status"] == "complete"


def test_equal_tensors_give_equal_bytes(tmp_path: Path) -> None:
    """Text in the header keeps the order of its names, as in the files of submaps."""
    text = {name: name for name in ("index", "camera", "detail_camera", "photo_camera")}
    for i in range(8):
        write_tensors(tmp_path / f"{i}.safetensors", {"params": torch.ones(3, 17)}, text)
    assert len({file.read_bytes() for file in tmp_path.iterdir()}) == 1


def test_the_text_files_are_on_the_disk_when_a_run_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The size of each file when it was synced for the last time is its size at the end."""
    synced: dict[int, int] = {}
    fsync = os.fsync

    def recorded(file: int) -> None:
        fsync(file)
        synced[os.fstat(file).st_ino] = os.fstat(file).st_size

    monkeypatch.setattr(os, "fsync", recorded)
    out = tmp_path / "run"
    assert exit_code(*run_of(out, 3)) == 0
    for name in ("log.jsonl", "trajectory.txt", "loops.json", "map.ply", "run.json", "checkpoint.safetensors"):
        found = (out / name).stat()
        assert synced.get(found.st_ino) == found.st_size > 0, name


def test_a_clock_that_is_set_back_or_forward_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that sleeps or sets its clock: only the monotonic clock is used for durations."""
    assert exit_code(*run_of(tmp_path / "steady", 6, "final.iterations=2")) == 0
    jumps = iter(range(10**9))
    monkeypatch.setattr(time, "time", lambda: 1e9 * (-1) ** next(jumps))
    assert exit_code(*run_of(tmp_path / "jumping", 6, "final.iterations=2"), "--save-every", "0.001") == 0
    for name in ("trajectory.txt", "map.ply", "checkpoint.safetensors"):
        assert (tmp_path / "steady" / name).read_bytes() == (tmp_path / "jumping" / name).read_bytes(), name
    facts = RunFolder(tmp_path / "jumping").facts()
    assert 0 < facts["wall_s"] < PATIENCE_S and 0 < facts["finish_s"] < PATIENCE_S
