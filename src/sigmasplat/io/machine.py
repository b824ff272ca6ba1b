"""Say on what and with what a run was made, for run.json and `doctor`."""

import hashlib
import os
import platform
import subprocess
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

SOURCES, RUNNING = (".py", ".cpp", ".h"), (".py", ".h", ".so")
"""Endings of what is written, and of what runs: compiled kernels with the headers that their text ships in."""


def package_version() -> str:
    """Return the installed version, or 'unknown' when run from a bare checkout."""
    try:
        return metadata.version("sigmasplat")
    except metadata.PackageNotFoundError:
        return "unknown"


def code_digest(folder: Path, endings: Sequence[str] = SOURCES) -> str:
    """Digest the files of a folder with these endings, names and bytes: equal digests mean equal code."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.suffix in endings):
        digest.update(str(path.relative_to(folder)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def cpu_model() -> str:
    """Return the processor's name as the kernel gives it, else the platform's word for it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def usable_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def code() -> str:
    """Return which code this is: the commit of the checkout that it runs from, else the one it was built of, either
    with -dirty where files had changed since; where neither is known, the version."""
    package = Path(__file__).resolve().parents[1]
    built_of = package / "commit.txt"
    return _commit_of(package.parents[1]) or (built_of.is_file() and built_of.read_text().strip()) or package_version()


def _commit_of(checkout: Path) -> str | None:
    """Return the commit of a folder that is itself a checkout: a repository further up would be somebody else's."""
    if not (checkout / ".git").exists():
        return None
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def describe() -> dict[str, Any]:
    """Return processor, cores, system and Python as plain values."""
    return {
        "cpu": cpu_model(),
        "cores": usable_cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }
