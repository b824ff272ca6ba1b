"""Compile the lanes of each instruction set on their own and compare them with their definition on single numbers."""

import os
import platform
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NATIVE = ROOT / "src/sigmasplat/native"
CHECKS = Path(__file__).parent / "compilers"
COMPILER = os.environ.get("CXX") or "g++"
SETS = {
    "portable": ["-U__SSE2__", "-U__ARM_NEON"],
    "baseline": [],
    "avx2": ["-mavx2", "-mfma"],
    "avx512": ["-mavx512f", "-mavx512dq", "-mavx512bw", "-mavx512vl", "-mavx2", "-mfma", "-Wno-uninitialized"],
}

needs_compiler = pytest.mark.skipif(not shutil.which(COMPILER), reason="no C++ compiler here")


def runs_here(isa: str) -> bool:
    """Return whether this processor has an instruction set."""
    if not isa.startswith("avx"):
        return True
    flags = Path("/proc/cpuinfo").read_text().split() if platform.machine() == "x86_64" else []
    return {"avx2": {"avx2", "fma"}, "avx512": {"avx512f", "avx512dq", "avx512bw", "avx512vl"}}[isa] <= set(flags)


def compare_lanes(isa: str, headers: Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Compile lanes.cpp with the headers of a folder for an instruction set, and run it."""
    flags = [
        "-std=gnu++20",
        "-O1",
        "-fno-math-errno",
        "-fno-trapping-math",
        "-ffp-contract=fast",
        "-Wall",
        "-Wextra",
        "-Werror",
    ]
    command = [COMPILER, *flags, *SETS[isa], f"-DSIGMASPLAT_ISA={isa}", f"-I{headers}", str(CHECKS / "lanes.cpp")]
    subprocess.run([*command, "-o", str(folder / "lanes")], check=True)
    return subprocess.run([str(folder / "lanes")], capture_output=True, text=True)


@needs_compiler
@pytest.mark.parametrize("isa", SETS)
def test_lane_operations_agree_with_their_definition(isa: str, tmp_path: Path) -> None:
    if not runs_here(isa):
        pytest.skip(f"this processor has no {isa}")
    answer = compare_lanes(isa, NATIVE, tmp_path)
    assert (answer.returncode, answer.stdout) == (0, "agree\n")


@needs_compiler
@pytest.mark.parametrize(
    ("operation", "written", "broken"),
    [
        ("max", "return a > b ? a : b;", "return a > b ? b : a;"),
        ("transpose", "(L & S ? L + W : L + S)", "(L & S ? L + W : L)"),
        ("exp2_alpha", "5.550713273e-2f", "5.560713273e-2f"),
        ("floor", "t > a ? t - 1.f : t;", "t;"),
    ],
)
def test_a_broken_lane_operation_is_found(operation: str, written: str, broken: str, tmp_path: Path) -> None:
    text = (NATIVE / "lanes.h").read_text(encoding="utf-8")
    assert text.count(written) == 1
    (tmp_path / "lanes.h").write_text(text.replace(written, broken), encoding="utf-8")
    answer = compare_lanes("portable", tmp_path, tmp_path)
    assert answer.returncode == 1 and f"differs: {operation}\n" in answer.stdout


@needs_compiler
def test_the_program_that_compares_kernels_calls_them_as_they_are() -> None:
    """Where compilers are missing, nothing else compiles it."""
    sizes = [f"-DSIGMASPLAT_TILE_{side}=16" for side in ("WIDTH", "HEIGHT")]
    command = [COMPILER, "-std=gnu++20", "-fsyntax-only", *sizes, f"-I{NATIVE}", str(CHECKS / "kernels.cpp")]
    answer = subprocess.run(command, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr


@pytest.mark.slow
def test_all_compilers_and_processors_agree() -> None:
    """Takes minutes where every program is installed; elsewhere the script says which one is missing."""
    if not shutil.which("bash"):
        pytest.skip("no bash here")
    answer = subprocess.run([str(ROOT / ".ci/compilers")], capture_output=True, text=True)
    if answer.returncode == 2:
        pytest.skip(answer.stderr.strip())
    assert answer.returncode == 0 and answer.stdout.endswith("all builds agree\n"), answer.stdout + answer.stderr
