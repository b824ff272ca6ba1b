"""A busy machine, clocks that jump, a pause of the process and a slow disk do not change a run; no frame waits."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from unittest import mock

import pytest

from command_line import exit_code
from run_process import lines, wait_for

ROOM = "synthetic:frames=8,width=48,height=36"
SETTINGS = ("input.width=48", "mapping.first_iterations=3", "mapping.iterations=2", "final.iterations=2")
JUMPING = """
import itertools, sys, time
true, jumps = time.time, itertools.cycle((0.0, 9e8, -9e8))
time.time = lambda: true() + next(jumps)
from sigmasplat import cli
cli.main(sys.argv[1:])
"""


def words(out: Path) -> list[str]:
    chosen = [word for setting in SETTINGS for word in ("--set", setting)]
    return ["run", ROOM, "--out", str(out), "--no-eval", "--save-every", "0.001", *chosen]


def contents(out: Path) -> list[bytes]:
    return [(out / name).read_bytes() for name in ("map.ply", "trajectory.txt", "checkpoint.safetensors")]


@pytest.mark.slow
def test_two_runs_at_once_with_jumping_clocks_and_a_pause_are_those_of_one_with_a_slow_disk(tmp_path: Path) -> None:
    outs = tmp_path / "one", tmp_path / "two"
    runs = [subprocess.Popen([sys.executable, "-c", JUMPING, *words(out)], stderr=subprocess.PIPE) for out in outs]
    synced, sync = [], os.fsync

    def slow_sync(file: int) -> None:
        synced.append(file)
        time.sleep(0.02)
        sync(file)

    try:
        wait_for(runs[0], lambda: lines(outs[0]) > 0)  # type: ignore[arg-type]
        runs[0].send_signal(signal.SIGSTOP)
        with mock.patch.object(os, "fsync", slow_sync):
            assert exit_code(*words(tmp_path / "alone")) == 0
        runs[0].send_signal(signal.SIGCONT)
        assert [run.wait(90) for run in runs] == [0, 0], [run.communicate() for run in runs]
    finally:
        for run in runs:
            run.kill()
            run.communicate()
    assert synced and lines(tmp_path / "alone") == 8
    assert contents(outs[0]) == contents(outs[1]) == contents(tmp_path / "alone")


def test_in_real_time_no_frame_waits_for_the_disk(tmp_path: Path) -> None:
    """While frames arrive, files are synchronised by the mapping thread only: here every one takes 50 ms."""
    out, sync, waited = tmp_path / "run", os.fsync, list[tuple[str, int]]()

    def slow_sync(file: int) -> None:
        waited.append((threading.current_thread().name, lines(out)))
        time.sleep(0.05)
        sync(file)

    with mock.patch.object(os, "fsync", slow_sync):
        assert exit_code(*words(out), "--realtime", "--set", "submaps.frames=3") == 0
    frames = lines(out)
    assert "mapping" in {thread for thread, _ in waited}
    assert {thread for thread, logged in waited if 0 < logged < frames} <= {"mapping"}, waited
