"""Describe the machine and the code version of a run, for run.json and `doctor`.

`hashlib` and `platform` are imported at first use: they are slow to import, and every command imports this module.
"""

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import sigmasplat

SOURCES, INSTALLED = (".py", ".cpp", ".h"), (".py", ".h", ".so")
"""Endings of source files, and of installed files: Python, compiled kernels, and the headers that CUDA compiles."""


def package_version() -> str:
    """Return the installed version, or 'unknown' in a checkout that is not installed."""
    return str(sigmasplat.__version__)


def code_digest(folder: Path, endings: Sequence[str] = SOURCES) -> str:
    """Return a digest of the names and bytes of a folder's files with these endings: equal digests mean equal code."""
    import hashlib

    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.suffix in endings):
        digest.update(str(path.relative_to(folder)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def cpu_model() -> str:
    """Return the processor's name from /proc/cpuinfo, else from Python's `platform`."""
    import platform

    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def usable_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def code_version() -> str:
    """Return the commit of the checkout that runs, else the commit that the package was built from, else the version.

    A commit ends in -dirty if files were changed since.
    """
    package = Path(__file__).resolve().parents[1]
    built_from = package / "commit.txt"
    built_commit = built_from.is_file() and built_from.read_text().strip()
    return _commit_of(package.parents[1]) or built_commit or package_version()


def _commit_of(checkout: Path) -> str | None:
    """Return the commit of a folder that is itself a checkout; a repository in a parent folder is not ours."""
    if not (checkout / ".git").exists():
        return None
    # git must not refresh the index of a checkout in which another command of git may run.
    asked = ["describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    command = ["git", "--no-optional-locks", "-C", str(checkout), *asked]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def describe() -> dict[str, Any]:
    """Return processor, cores, system and Python version."""
    import platform

    return {
        "cpu": cpu_model(),
        "cores": usable_cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }
