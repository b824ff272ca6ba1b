"""A run that is stopped from outside, politely or not: what lies in its folder afterwards can be read or is refused."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from sigmasplat import cli
from sigmasplat.errors import RunError
from sigmasplat.io.runs import RunFolder

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

ROOM = "synthetic:frames=200,width=80,height=60"
QUICK = ["input.width=80", "mapping.first_iterations=5", "mapping.iterations=3"]
PATIENCE_S = 90.0


@contextmanager
def running(out: Path) -> Iterator[subprocess.Popen[str]]:
    """Start a run in a process of its own; never leave it behind."""
    settings = [word for setting in QUICK for word in ("--set", setting)]
    command = [sys.executable, "-m", "sigmasplat.cli", "run", ROOM, "--out", str(out), *settings]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def wait_for(process: subprocess.Popen[str], happened: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not happened():
        assert process.poll() is None, f"ended too early: {process.communicate()}"
        assert time.monotonic() < deadline_s, "nothing happened"
        time.sleep(0.01)


def lines(out: Path) -> int:
    """Count the whole lines of the log."""
    log = out / "log.jsonl"
    return log.read_text().count("\n") if log.exists() else 0


def test_ctrl_c_leaves_a_run_to_work_with(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    with running(out) as process:
        wait_for(process, lambda: lines(out) >= 3)
        process.send_signal(signal.SIGINT)
        said, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, errors
    assert "Traceback" not in said + errors and "interrupted after" in said + errors

    run = RunFolder.open(out)
    assert run.facts()["status"] == "interrupted"
    log, path, field = run.read_log(), run.read_trajectory(), run.read_map()
    assert 3 <= len(log) == len(path) < 200
    assert len(field) == log[-1]["splats"] > 100 and torch.isfinite(field.params).all()
    tensors, metadata = run.read_checkpoint()
    assert metadata == {"frames": str(len(log))}
    torch.testing.assert_close(tensors["params"], field.params, rtol=0, atol=1e-5)
    assert run.config().input.width == 80

    with pytest.raises(SystemExit) as left:
        cli.main(["export", str(out), "--out", str(tmp_path / "map.ply")])
    assert left.value.code == 0 and (tmp_path / "map.ply").stat().st_size > 1000
    capsys.readouterr()


@pytest.mark.parametrize("moment", ["folder", "log"])
def test_a_killed_run_is_read_or_refused_in_one_line(
    tmp_path: Path, moment: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    with running(out) as process:
        wait_for(process, out.exists if moment == "folder" else lambda: lines(out) >= 2)
        process.send_signal(signal.SIGKILL)
        process.wait(timeout=PATIENCE_S)
    assert process.returncode == -signal.SIGKILL

    if moment == "log":
        run = RunFolder.open(out)
        assert run.facts()["status"] == "running" and len(run.read_log()) >= 2
        with pytest.raises(RunError, match=r"has no map\.ply; did it stop before writing it"):
            run.read_map()
    else:
        try:
            assert RunFolder.open(out).facts()["status"] == "running"
        except RunError as problem:
            assert "not a run folder of ours" in str(problem)

    for command in (["eval", str(out)], ["export", str(out), "--out", str(tmp_path / "map.ply")]):
        with pytest.raises(SystemExit) as left:
            cli.main(command)
        refusal = capsys.readouterr().err
        assert left.value.code == 2 and refusal.startswith("sigmasplat: ") and refusal.count("\n") == 1, refusal


def test_a_killed_run_can_be_run_again(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with running(out) as process:
        wait_for(process, lambda: lines(out) >= 1)
        process.kill()
        process.wait(timeout=PATIENCE_S)
    with pytest.raises(SystemExit) as left:
        cli.main(["run", "synthetic:frames=2,width=80,height=60", "--limit", "1", "--out", str(out), "--overwrite",
                  "--set", "input.width=80", "--set", "mapping.first_iterations=2", "--no-eval"])  # fmt: skip
    assert left.value.code == 0
    assert RunFolder.open(out).facts()["status"] == "complete" and len(RunFolder.open(out).read_log()) == 1
