"""The scripts for releases say in one line why they did not do their work."""

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def program(path: Path, text: str) -> str:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


def ran(script: str, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | variables
    return subprocess.run(
        [ROOT / ".ci" / script, *arguments], env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(("script", "variable"), [("audit", "PIP_AUDIT"), ("lock", "UV")])
def test_a_missing_program_is_one_line(script: str, variable: str, tmp_path: Path) -> None:
    done = ran(script, str(tmp_path / "lock"), **{variable: "no-such-program"})
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "pip install" in done.stderr
    assert not (tmp_path / "lock").exists()


@pytest.mark.parametrize(
    ("output", "code", "expected"),
    [
        ("echo No known vulnerabilities found", 0, 0),
        ("echo Found 2 known vulnerabilities in 1 package", 1, 1),
        ("echo requests.exceptions.ConnectionError: Max retries exceeded", 1, 2),
        ("echo torch Dependency not found on PyPI and could not be audited", 0, 2),
        ("echo a fault of pip-audit itself", 1, 2),
    ],
)
def test_an_audit_passes_only_if_everything_was_looked_up(
    output: str, code: int, expected: int, tmp_path: Path
) -> None:
    done = ran("audit", PIP_AUDIT=program(tmp_path / "audit", f"{output}; exit {code}"))
    assert done.returncode == expected
    assert done.stderr.count("\n") == (1 if expected == 2 else 0)


def test_a_failed_lock_leaves_the_earlier_file(tmp_path: Path) -> None:
    target = tmp_path / "lock"
    target.write_text("earlier")
    done = ran("lock", str(target), UV=program(tmp_path / "uv", "echo no connection >&2; exit 1"))
    assert done.returncode == 2 and "no connection" in done.stderr and target.read_text() == "earlier"
    done = ran("lock", str(target), UV=program(tmp_path / "uv", "echo 'a==1 --hash=sha256:0'"))
    assert done.returncode == 0 and target.read_text().startswith("a==1")
