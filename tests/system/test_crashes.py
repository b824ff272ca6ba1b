"""Kills and power failures at file operations: a small part of benchmarks/crashes.py."""

import os
import random
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from benchmark_results import BENCHMARKS, laid_out

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
power_loss = import_module("power_loss")


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.slow
def test_killed_commands_and_power_failures_lose_nothing(tmp_path: Path) -> None:
    command = [sys.executable, str(BENCHMARKS / "crashes.py"), "--quick", "--scratch", str(tmp_path)]
    ended = subprocess.run(
        [*command, "--kills", "4", "--power-cuts", "4"], capture_output=True, text=True, env=os.environ
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "| kill -9 | **all** |" in ended.stdout and "| power failure | **all** |" in ended.stdout


def test_a_power_failure_loses_what_was_not_synced(tmp_path: Path) -> None:
    """A rename without fsync of the content leaves a file that is cut, or an earlier name."""
    found = set[tuple[str, int]]()
    for seed in range(40):
        folder = tmp_path / str(seed)
        folder.mkdir()
        new, path = folder / "part", folder / "file"
        new.write_bytes(b"x" * 100)
        operations = [
            {"kind": "create", "path": str(new), "source": str(new)},
            {"kind": "rename", "path": str(path), "source": str(new)},
        ]
        new.rename(path)
        power_loss.lose(folder, operations, {}, random.Random(seed))
        left = list(folder.iterdir())
        found |= {(file.name, file.read_bytes().count(b"x")) for file in left} or {("nothing", 0)}
    assert ("nothing", 0) in found and {"file", "part"} <= {name for name, _ in found}
    assert any(name == "file" and size < 100 for name, size in found)


def test_a_power_failure_keeps_what_was_synced(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"x" * 100)
    status = path.stat()
    operations = [
        {"kind": "create", "path": str(path), "source": str(path)},
        {"kind": "sync", "path": str(path), "inode": status.st_ino, "size": 60},
        {"kind": "sync", "path": str(tmp_path), "inode": 0, "size": 0},
    ]
    power_loss.lose(tmp_path, operations, {}, random.Random(0))
    assert path.read_bytes().startswith(b"x" * 60)


def test_the_table_of_crashes_counts_kills_and_failures() -> None:
    case = {"kind": "kill -9", "stage": "run", "at": 3, "crashes": ["frames", "cut"], "again": 1, "losses": 0}
    cases = [{**case, "problem": ""}, {**case, "problem": "map.ply differs"}]
    made = laid_out("crashes", {"operations": {"run": 9}, "cases": cases})
    assert list(made["Crashes"].rows[-1]) == ["kill -9", "**all**", "2", "4", "1", "1"]
    assert len(made["Failed"].rows) == 1
