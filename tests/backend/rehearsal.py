"""Run a program where there is no CUDA device as if there were one: the stand-in for a device, a few quick iterations.

benchmarks/flight.sh --rehearse takes this for its Python: python tests/backend/rehearsal.py PROGRAM ARGUMENTS…, as in
-m MODULE, -c CODE, FILE. pytest runs as it is, because tests have a stand-in of their own; --tool NAME … runs the
Python command that a tool, such as ncu, is to look at. $REHEARSAL: a folder for what is compiled, by default one that
is removed.
"""

import importlib
import os
import runpy
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]


def run(words: list[str]) -> None:
    """Run a program as Python does."""
    kind, *rest = words
    if kind == "-c":
        sys.argv = ["-c", *rest[1:]]
        exec(rest[0], {"__name__": "__main__"})
    elif kind == "-m":
        sys.argv = rest
        runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
    else:
        sys.argv, sys.path[0] = words, str(Path(kind).resolve().parent)
        runpy.run_path(kind, run_name="__main__")


def run_on_the_stand_in(words: list[str]) -> None:
    """Run a program on the stand-in device, with fits of two iterations and no graphs."""
    sys.path[:0] = [str(HERE), str(HERE.parent), str(ROOT / "benchmarks")]
    import torch

    from emulated_cuda import Emulator
    from sigmasplat.plugins.cuda import descent
    from sigmasplat.render import self_test
    from stand_in import library_in, standing_in

    works: Any = importlib.import_module("gpu_works")
    works.WARMUPS, works.ITERATIONS, works.TRACKING_ITERATIONS = 0, 2, 2
    torch.cuda.reset_peak_memory_stats = torch.cuda.empty_cache = lambda *_: None
    torch.cuda.max_memory_allocated = lambda *_: 0
    descent.repeatable = lambda work, device: work
    self_test.SPLATS, self_test.ROUNDS = 100, 1
    with ExitStack() as stack:
        folder = Path(os.environ.get("REHEARSAL") or stack.enter_context(TemporaryDirectory()))
        stack.enter_context(standing_in(Emulator(folder), library_in(folder)))
        run(words)


def main(words: list[str]) -> int:
    """Run a program, as the head of this file says; return its exit code."""
    if words[0] == "--tool":
        own = next(i for i, word in enumerate(words) if word.endswith("rehearsal.py"))
        return subprocess.run([sys.executable, *words[own:]]).returncode
    if words[:2] == ["-m", "pytest"]:
        return subprocess.run([sys.executable, *words]).returncode
    run_on_the_stand_in(words)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
