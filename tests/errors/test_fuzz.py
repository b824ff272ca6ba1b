"""Commands on mutated files: each is refused in one line, or used without harm. Past failures stay repaired.

`benchmarks/fuzz.py` runs many more inputs.
"""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
for module in ("cv2", "rosbags", "lzfse", "OpenEXR"):
    pytest.importorskip(module)

FUZZ = Path(__file__).resolve().parents[2] / "benchmarks" / "fuzz.py"


def fuzz(*options: str) -> None:
    """Run the fuzzer in a process of its own: it forks, and this process may have threads."""
    ended = subprocess.run(
        [sys.executable, str(FUZZ), "--quiet", *options], capture_output=True, text=True, timeout=500
    )
    assert ended.returncode == 0, ended.stdout[-5000:] + ended.stderr[-2000:]


@pytest.mark.slow
def test_mutated_inputs_are_refused_in_one_line_or_used() -> None:
    fuzz("--minutes", "2", "--jobs", "1")


def test_past_failures_stay_repaired() -> None:
    fuzz("--corpus")
