"""The flight to a GPU (benchmarks/flight.sh), rehearsed where there is none: its steps, their ends, what travels."""

import json
import os
import re
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

from emulated_cuda import Emulator
from sigmasplat.plugins.cuda import launch as cuda_launch

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

ROOT = Path(__file__).parents[2]
A, B = ("doctor", "device", "bench", "profile", "sigma", "varsplat", "cgslam"), ("ncu", "memcheck", "racecheck")
RESULTS = {"gpu", "gpu-profile", "gpu-sigma", "gpu-varsplat-tum", "gpu-cgslam-tum"}


def fly(*words: str, **named: object) -> subprocess.CompletedProcess[str]:
    """Run the script with these environment variables, as if no test ran it."""
    outside = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    given = {"PYTHON": sys.executable, "PYTHONPATH": ROOT / "src", "FLIGHT_COMMIT": "abc"} | named
    line = ["bash", str(ROOT / "benchmarks" / "flight.sh"), *words]
    environment = outside | {name: str(value) for name, value in given.items()}
    return subprocess.run(line, env=environment, capture_output=True, text=True)


def packed(archive: Path) -> dict[str, bytes]:
    """Return the files of an archive by their names."""
    with tarfile.open(archive) as files:
        return {m.name.removeprefix("./"): files.extractfile(m).read() for m in files if m.isfile()}  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.skipif(cuda_launch.missing() is None, reason="there is a CUDA device: fly")
def test_the_whole_flight_is_rehearsed(emulator: Emulator, tmp_path: Path) -> None:
    done = fly("--rehearse", OUT=tmp_path, REHEARSAL=emulator.folder, PATIENCE=10)
    files = packed(tmp_path / "flight-a.tar.gz") | packed(tmp_path / "flight-b.tar.gz")
    ends = dict(re.findall(r"^(\w+): (exit \d+)", done.stdout, re.MULTILINE))
    assert ends == dict.fromkeys(A + B, "exit 0"), done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"flight-a.tar.gz", "flight-b.tar.gz", "summary.txt"}
    assert {f"{name}.log" for name in A + B} <= files.keys() and "machine.txt" in files
    written = [json.loads(text) for name, text in files.items() if name.startswith("results/")]
    assert {each["name"] for each in written} == RESULTS
    for each in written:
        assert each["figures"]["device"]["name"] == "stand-in" and "driver" in each["figures"]["device"]
        assert each["commit"] and each["code"]
    assert not [name for name, text in files.items() if name.endswith(".log") and b"Traceback" in text]


def test_a_step_that_fails_or_takes_too_long_stops_no_other(tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\ncase "$*" in *doctor*) exec sleep 60;; *-m*pytest*) echo no; exit 3;; esac\n')
    python.chmod(0o755)
    given = {"OUT": tmp_path / "out", "PYTHON": python, "FLIGHT": tmp_path / "nothing", "LIMIT_doctor": 1}
    done = fly("a", "doctor", "device", "sigma", "memcheck", "unknown", **given)
    summary = (tmp_path / "out" / "summary.txt").read_text().splitlines()
    assert summary[:3] == ["doctor: stopped after 1 s", "device: exit 3, 0 s", "sigma: exit 0, 0 s"], done.stdout
    assert summary[3:] == ["memcheck: left out, its program is not here"] and "no step unknown" in done.stderr
    assert packed(tmp_path / "out" / "flight-a.tar.gz")["device.log"] == b"no\n"


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="what travels is asked of git")
def test_the_two_calls_are_printed_and_what_is_too_large_is_refused(tmp_path: Path) -> None:
    assert "empty; run prepare" in fly("calls", FLIGHT=tmp_path).stderr
    for name in ("wheels", "cubins", "frames"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text(name)
    first, *calls = fly("calls", FLIGHT=tmp_path).stdout.splitlines()
    assert "of 64 MiB travel" in first
    a, b = map(json.loads, calls)
    assert (a["timeout_s"], b["timeout_s"]) == (420, 300) and a["carry"] == b["carry"] == [str(tmp_path)]
    assert a["command"].endswith("bash benchmarks/flight.sh a") and b["command"].endswith("benchmarks/flight.sh b")
    with (tmp_path / "frames" / "file").open("w") as large:
        large.truncate(64 << 20)
    refused = fly("calls", FLIGHT=tmp_path)
    assert refused.returncode == 1 and "too much" in refused.stderr
