"""A run folder belongs to one writing process at a time; a resumed run belongs to one sequence."""

import errno
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from command_line import exit_code
from run_process import PATIENCE_S, ROOM, lines, running, wait_for
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder
from tum_recording import write_tum

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

FRAMES = 16
SHORT = ("--set", "input.width=80", "--set", "mapping.first_iterations=2", "--set", "final.iterations=2",
         "--limit", "1", "--no-eval")  # fmt: skip


def refusal(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    """Run a command that must be refused in one line, and return the line."""
    capsys.readouterr()
    assert exit_code(*command) == 2, command
    line = capsys.readouterr().err
    assert line.startswith("sigmasplat: ") and line.count("\n") == 1, line
    return line


def test_a_second_process_is_refused_until_the_first_one_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    writers = (
        ["resume", str(out)], ["run", ROOM, "--out", str(out), "--overwrite", *SHORT], ["eval", str(out)],
        ["mesh", str(out)],
    )  # fmt: skip
    with running(out) as process:
        wait_for(process, lambda: lines(out) >= 2)
        for command in writers:
            line = refusal(capsys, *command)
            assert str(out) in line and f"process {process.pid}" in line and "kill" in line
        assert len(RunFolder.open(out).read_log()) >= 2
        process.send_signal(signal.SIGSTOP)
        assert f"kill {process.pid}" in refusal(capsys, "resume", str(out))
        process.kill()
        process.wait(timeout=PATIENCE_S)
    assert exit_code("run", ROOM, "--out", str(out), "--overwrite", *SHORT) == 0
    assert RunFolder.open(out).facts()["status"] == "complete"


HOLD = """
import sys
from pathlib import Path
from sigmasplat.files.lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_commands_that_only_read_need_no_lock(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, target = tmp_path / "run", tmp_path / "map.ply"
    assert exit_code("run", ROOM, "--out", str(out), *SHORT) == 0
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(out)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ
    ) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
        assert "is in use" in refusal(capsys, "eval", str(out))
        assert exit_code("export", str(out), "--out", str(target)) == 0
        assert "is in use" in refusal(capsys, "run", ROOM, "--onto", str(out), "--out", str(tmp_path / "onto"), *SHORT)
        holder.communicate()
    assert target.is_file() and exit_code("eval", str(out)) == 0
    program, other = HOLD.replace("locked", "output_locked"), tmp_path / "other.ply"
    with subprocess.Popen(
        [sys.executable, "-c", program, str(other)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ
    ) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
        for command in (["mesh"], ["export"], ["export", "--format", "colmap"]):
            line = refusal(capsys, *command, str(out), "--out", str(other))
            assert f"output {other} is in use by process {holder.pid}" in line
        holder.communicate()
    assert exit_code("export", str(out), "--out", str(other)) == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["map.ply", "other.ply", "run"]
    assert not any(entry.name.startswith(".") for entry in out.iterdir())


def test_blocks_of_one_process_share_the_lock(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    ended: list[bool] = []

    def inner() -> None:
        with run.locked():
            ended.append(True)

    with run.locked():
        with run.locked():
            pass
        thread = threading.Thread(target=inner)
        thread.start()
        thread.join()
        taken = subprocess.run([sys.executable, "-c", HOLD, str(tmp_path)], capture_output=True, env=os.environ)
        assert b"is in use" in taken.stderr
    assert ended and not any(tmp_path.iterdir())


def test_a_file_system_without_locks_gets_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(file: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", no_locks)
    warnings: list[str] = []
    with RunFolder(tmp_path).locked(warnings.append):
        pass
    assert len(warnings) == 1 and "has no locks" in warnings[0]


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording and a run on it that was killed after some frames, with a state."""
    folder = tmp_path_factory.mktemp("stopped")
    write_tum(open_source(ROOM, limit=FRAMES), folder / "room")
    with running(folder / "run", room=str(folder / "room"), more=("--save-every", "0.001")) as process:
        wait_for(process, lambda: lines(folder / "run") >= 8)
    return folder


def without_line(number: int, *names: str) -> Callable[[Path], None]:
    """Remove one line of the lists of images."""

    def change(room: Path) -> None:
        for name in names:
            kept = (room / name).read_text().splitlines(keepends=True)
            del kept[number]
            (room / name).write_text("".join(kept))

    return change


def other_calibration(**values: float) -> Callable[[Path], None]:
    def change(room: Path) -> None:
        path = room / "calibration.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    return change


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (without_line(3, "rgb.txt", "depth.txt"), "frame 2"),
        (without_line(-1, "rgb.txt", "depth.txt"), f"it has {FRAMES - 1} frames, it had {FRAMES}"),
        (other_calibration(fx=70.0), "fx is 70, it was 64"),
        (other_calibration(depth_scale=1000.0), "depth_units_per_metre is 1000, it was 5000"),
    ],
)
def test_a_changed_sequence_is_not_resumed(
    stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Callable[[Path], None], named: str
) -> None:
    shutil.copytree(stopped, tmp_path / "copy")
    room, run = tmp_path / "copy/room", tmp_path / "copy/run"
    change(room)
    log = (run / "log.jsonl").read_bytes()
    line = refusal(capsys, "resume", str(run), "--source", str(room), "--no-eval")
    assert named in line and "--source" in line
    assert (run / "log.jsonl").read_bytes() == log


def test_a_copy_of_the_sequence_is_resumed_without_leftovers(stopped: Path, tmp_path: Path) -> None:
    shutil.copytree(stopped, tmp_path / "copy")
    run = tmp_path / "copy/run"
    leftovers = [run / ".tmpa1B2c3", run / ".state.safetensors.part", run / "submaps/.tmpZZ9yX0"]
    own = [run / ".tmp-notes", run / "notes.part", run / ".tmpa1B2c3d4", run / ".hidden.doc.part"]
    (run / "submaps").mkdir(exist_ok=True)
    for file in (*leftovers, *own):
        file.write_text("half")
    assert exit_code("resume", str(run), "--source", str(tmp_path / "copy/room"), "--no-eval") == 0
    assert [file for file in leftovers if file.exists()] == [] and all(file.exists() for file in own)
    for file in leftovers[:2]:
        file.write_text("half")
    assert exit_code("run", ROOM, "--out", str(run), "--overwrite", *SHORT) == 0
    assert [file for file in leftovers if file.exists()] == [] and all(file.exists() for file in own)


@pytest.mark.slow
def test_two_runs_at_once_have_their_own_folders(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    few = ("input.limit=12", "final.iterations=4")
    with running(first, *few, more=("--no-eval",)) as one, running(second, *few, more=("--no-eval",)) as two:
        for process in (one, two):
            _, errors = process.communicate(timeout=PATIENCE_S)
            assert process.returncode == 0, errors
    for name in ("trajectory.txt", "map.ply", "checkpoint.safetensors"):
        assert (first / name).read_bytes() == (second / name).read_bytes(), name
