"""Record what a benchmark measured: one JSON file per benchmark and machine, with what is needed to repeat it."""

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from sigmasplat.errors import ConfigError
from sigmasplat.files import machine
from sigmasplat.files.machine import code_digest

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
MEASURED = ("src", "CMakeLists.txt", "benchmarks", ":!benchmarks/results", ":!benchmarks/*.md")
"""The files that figures depend on, as git path specifications."""
LOAD_AVERAGE = round(os.getloadavg()[0], 2)
"""The load in the minute before the program started: near 0 on an idle machine."""


def data_root() -> Path:
    """Return the folder of the real sequences: $SIGMASPLAT_DATA, otherwise ../shared/data beside the checkout."""
    return Path(os.environ.get("SIGMASPLAT_DATA", ROOT.parent / "shared" / "data"))


def slug(text: str) -> str:
    """Turn the name of a processor or a sequence into a file name: lower case, words joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", re.sub(r"\((r|tm)\)", " ", text.lower())).strip("-") or "unknown"


def machine_slug(described: dict[str, Any]) -> str:
    """Return a machine's name from processor and cores, as `sigmasplat.files.machine.describe()` gives them."""
    return f"{slug(str(described['cpu']))}-{described['cores']}-cores"


def commit() -> dict[str, Any]:
    """Return the commit of the checkout and whether the code differs from it.

    Outside git: that of $FLIGHT_COMMIT (benchmarks/flight.sh), with a + behind it if the code differs; else both None.
    """
    head = _git("rev-parse", "--verify", "HEAD")
    if head is None:
        given = os.environ.get("FLIGHT_COMMIT")
        return {"commit": given.rstrip("+"), "dirty": given.endswith("+")} if given else {"commit": None, "dirty": None}
    return {"commit": head, "dirty": bool(_git("status", "--porcelain", "--untracked-files=no", "--", *MEASURED))}


def _git(*words: str) -> str | None:
    """Return the output of a git command in the checkout; None if it fails."""
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
    """Return figures with machine, commit, date and command; `name` names the results, by default as the program."""
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


def refuse_unwritable(folder: Path) -> None:
    """Check before anything is measured that results can be written. Raises ConfigError if they cannot."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    except OSError as problem:
        raise ConfigError(f"results cannot be written to {folder} ({problem.strerror}); give another --out") from None


def write(measured: dict[str, Any], folder: Path = RESULTS) -> Path:
    """Write results as <name>-<machine>.json, replacing those of the same name and machine; return the path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{slug(measured['name'])}-{machine_slug(measured['machine'])}.json"
    write_json(measured, path)
    return path


def write_json(values: dict[str, Any], path: Path) -> None:
    """Write a JSON file, whole or not at all."""
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(values, indent=1, allow_nan=False, default=os.fspath) + "\n", encoding="utf-8")
    temporary.replace(path)


def read(path: Path) -> dict[str, Any]:
    """Read results written by `write`. Raises OSError or ValueError if they are missing or damaged."""
    measured: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return measured


def latest(name: str, folder: Path = RESULTS) -> dict[str, Any] | None:
    """Return the newest results of a name from any machine, or those of an exact file stem; None without results."""
    exact = folder / f"{name}.json"
    found = [read(exact)] if exact.is_file() else [read(path) for path in sorted(folder.glob(f"{slug(name)}-*.json"))]
    named = found if exact.is_file() else [measured for measured in found if measured["name"] == name]
    return max(named, key=lambda measured: str(measured["date"]), default=None)
