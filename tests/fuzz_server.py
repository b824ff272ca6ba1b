"""Run commands on hostile inputs, each in a forked process with limits, and classify how it ends.

The parent imports what the commands need, so that a fork costs milliseconds.
"""

import importlib
import os
import pkgutil
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuzz_mutations import Files, write_files
from fuzz_samples import INPUT, OUT, Sample

REFUSED, HARMLESS, TRACEBACK, HANG, MEMORY = "refused", "harmless", "traceback", "hang", "memory"
FAILURES = (TRACEBACK, HANG, MEMORY)
MOST_S, MOST_BYTES = 10.0, 1 << 30
CRASHED = 70
USAGE = "For full helptext, "
"""The end of what is printed if options are unknown or lack their value: a box with the reason."""
FINE = {0, 1}
"""Exit codes of commands that have used the input: 1 means that they warn, or find no image."""


@dataclass(frozen=True)
class Ending:
    """How a command ended: one of the kinds above, its exit code, its standard error, processor time and memory."""

    kind: str
    code: int
    error: str
    cpu_s: float
    peak_bytes: int


def warm_up() -> None:
    """Import the package and the libraries that it imports late."""
    import sigmasplat

    for module in pkgutil.walk_packages(sigmasplat.__path__, "sigmasplat."):
        if not any(part in module.name for part in (".cuda", "realsense", "__main__")):
            try:
                importlib.import_module(module.name)
            except ImportError:
                continue
    for name in ("cv2", "lzfse", "OpenEXR", "rosbags.rosbag1", "rosbags.rosbag2", "rosbags.typesys", "scipy.spatial"):
        try:
            importlib.import_module(name)
        except ImportError:
            continue
    from PIL import Image

    Image.init()


def run_files(sample: Sample, files: Files, command: Sequence[str], folder: Path) -> Ending:
    """Write the files below an empty folder, run the command on them, and delete them."""
    place = folder / "in"
    place.mkdir(parents=True)
    try:
        write_files(place, files)
        words = [w for word in command for w in (_lines(place / word[1:]) if word.startswith("@") else [word])]
        words = [word.replace(INPUT, str(place / sample.entry)).replace(OUT, str(folder / "out")) for word in words]
        return run_command(words, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _lines(path: Path) -> list[str]:
    """Return the lines of a file of options as a shell passes them: no NUL."""
    return path.read_text(errors="surrogateescape").replace("\0", "").splitlines() if path.is_file() else []


def _show_once() -> None:
    """Make `view` end when it has read a run, before it waits for a browser."""
    from sigmasplat.plugins.viewer import snapshot_sources

    read = snapshot_sources.finished_snapshot

    def read_once(run: Any) -> None:
        read(run)
        sys.exit(0)  # Ctrl-C would be 130: nothing is shown yet

    snapshot_sources.finished_snapshot = read_once


def run_command(arguments: Sequence[str], folder: Path) -> Ending:
    """Run `sigmasplat` with these arguments in a fork."""
    errors = folder / "stderr"
    started_s = time.monotonic()
    child = os.fork()
    if child == 0:
        _run_in_child(arguments, errors, folder)
    killed = False
    while True:
        ended, status, usage = os.wait4(child, os.WNOHANG)
        if ended:
            break
        if time.monotonic() - started_s > 6 * MOST_S:
            os.kill(child, signal.SIGKILL)
            killed = True
            _, status, usage = os.wait4(child, 0)
            break
        time.sleep(0.002)
    code = os.waitstatus_to_exitcode(status)
    error = errors.read_text(errors="replace") if errors.exists() else ""
    peak = int(error.rpartition("peak ")[2] or 0) if "\npeak " in f"\n{error}" else 0
    error = f"\n{error}".rpartition("\npeak ")[0].strip() if peak else error
    return Ending(_kind(code, error, killed or usage.ru_utime > MOST_S, peak), code, error, usage.ru_utime, peak)


def _kind(code: int, error: str, slow: bool, peak: int) -> str:
    if slow or code == -signal.SIGXCPU:
        return HANG
    if peak > MOST_BYTES:
        return MEMORY
    lines = [line for line in error.splitlines() if line.startswith("sigmasplat: ")]
    if code == 2 and (len(lines) == 1 or USAGE in error) and "Traceback" not in error:
        return REFUSED
    return HARMLESS if code in FINE and "Traceback" not in error else TRACEBACK


def _run_in_child(arguments: Sequence[str], errors: Path, folder: Path) -> None:
    """Run the command, write its errors and the memory that it needed, and end the process."""
    code = CRASHED
    try:
        os.chdir(folder)
        os.setsid()
        null, file = os.open(os.devnull, os.O_RDWR), os.open(errors, os.O_WRONLY | os.O_CREAT)
        os.dup2(null, 0)
        os.dup2(null, 1)
        os.dup2(file, 2)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", errors="backslashreplace", closefd=False)  # noqa: SIM115
        before = _status("VmRSS")
        with open("/proc/self/clear_refs", "w") as reset:  # 5: the peak starts again
            reset.write("5")
        limit = _status("VmSize") + 4 * MOST_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CPU, (int(MOST_S) + 2, int(MOST_S) + 4))
        from sigmasplat import cli

        if arguments[:1] == ["view"]:
            _show_once()
        try:
            cli.main(arguments)
        except SystemExit as left:
            code = left.code if isinstance(left.code, int) else CRASHED
        except BaseException:
            traceback.print_exc()
        sys.stderr.flush()
        os.write(2, f"\npeak {max(1, _status('VmHWM') - before)}".encode())
    finally:
        os._exit(code)


def _status(name: str) -> int:
    """Return a number of this process' memory in bytes."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith(name + ":"))
