"""Keep what a benchmark measured: one JSON per benchmark and machine, with all it takes to measure it again."""

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sigmasplat.io import machine
from sigmasplat.io.machine import code_digest

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
MEASURED = ("src", "CMakeLists.txt", "benchmarks", ":!benchmarks/results", ":!benchmarks/*.md")
"""What the figures depend on, as git path specifications."""
LOAD_AVERAGE = round(os.getloadavg()[0], 2)
"""Of the minute before the program started: near 0 where the machine was left alone."""


def data_root() -> Path:
    """Return the folder of the real sequences: $SIGMASPLAT_DATA, else ../shared/data beside the checkout."""
    return Path(os.environ.get("SIGMASPLAT_DATA", ROOT.parent / "shared" / "data"))


def slug(text: str) -> str:
    """Turn a processor's or a sequence's name into a file name: lower case, words joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", re.sub(r"\((r|tm)\)", " ", text.lower())).strip("-") or "unknown"


def machine_slug(described: dict[str, Any]) -> str:
    """Name a machine by processor and cores, from `sigmasplat.io.machine.describe()`."""
    return f"{slug(str(described['cpu']))}-{described['cores']}-cores"


def commit() -> dict[str, Any]:
    """Return the checkout's commit and whether code differs from it; both None outside git."""
    head = _git("rev-parse", "--verify", "HEAD")
    if head is None:
        return {"commit": None, "dirty": None}
    return {"commit": head, "dirty": bool(_git("status", "--porcelain", "--untracked-files=no", "--", *MEASURED))}


def _git(*words: str) -> str | None:
    """Return what git says of the checkout, None if it cannot."""
    try:
        answer = subprocess.run(
            ["git", "-C", str(ROOT), *words], capture_output=True, text=True, timeout=20, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def results(
    benchmark: str, figures: dict[str, Any], *, name: str = "", seeds: Sequence[int] = (), config: Any = None
) -> dict[str, Any]:
    """Lay out figures with their circumstances: benchmark is the program, name what it is called here (the same)."""
    return {
        "name": name or benchmark,
        "benchmark": benchmark,
        "machine": machine.describe(),
        "load_average_before": LOAD_AVERAGE,
        **commit(),
        "code": code_digest(ROOT / "src"),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "seeds": list(seeds),
        "config": config,
        "command": shlex.join(["python", *sys.argv]),
        "figures": figures,
    }


def write(measured: dict[str, Any], folder: Path = RESULTS) -> Path:
    """Write results as <name>-<machine>.json, replacing those of the same name and machine; return the path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{slug(measured['name'])}-{machine_slug(measured['machine'])}.json"
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(measured, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    temporary.replace(path)
    return path


def read(path: Path) -> dict[str, Any]:
    """Read results written by `write`. Raises OSError or ValueError if they are not there or damaged."""
    measured: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return measured


def latest(name: str, folder: Path = RESULTS) -> dict[str, Any] | None:
    """Return the newest results of a name whatever the machine, or those of an exact file stem; None without any."""
    exact = folder / f"{name}.json"
    found = [read(exact)] if exact.is_file() else [read(path) for path in sorted(folder.glob(f"{slug(name)}-*.json"))]
    named = found if exact.is_file() else [measured for measured in found if measured["name"] == name]
    return max(named, key=lambda measured: str(measured["date"]), default=None)
