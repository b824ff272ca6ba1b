"""The files around the code: citation, public continuous integration, commit hooks."""

import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def read_yaml(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def test_the_citation_names_this_release() -> None:
    cited = read_yaml("CITATION.cff")
    for name in ("version", "license", "keywords"):
        assert cited[name] == PROJECT[name]
    assert cited["cff-version"] == "1.2.0" and cited["title"].endswith(PROJECT["description"])
    assert cited["references"][0]["url"] in PROJECT["urls"].values()


def test_public_ci_runs_every_python_on_both_processors() -> None:
    jobs = read_yaml(".github/workflows/ci.yml")["jobs"]
    matrix = jobs["test"]["strategy"]["matrix"]
    assert {f"Programming Language :: Python :: {each}" for each in matrix["python"]} <= set(PROJECT["classifiers"])
    assert len(matrix["python"]) == 3 and [name.endswith("-arm") for name in matrix["machine"]] == [False, True]
    assert [step["run"] for step in jobs["test"]["steps"] if "run" in step] == ["make test"]


def test_the_commit_hook_counts_the_characters_of_the_subject(tmp_path: Path) -> None:
    hooks = read_yaml(".pre-commit-config.yaml")["repos"][0]["hooks"]
    (entry,) = (hook["entry"] for hook in hooks if hook.get("stages") == ["commit-msg"])
    for length, code in ((72, 0), (73, 1)):
        (tmp_path / "message").write_text("–" * length + "\n\n" + "a long line of the body " * 9, encoding="utf-8")
        words = shlex.split(entry)
        assert words[0] == ".venv/bin/python"
        answer = subprocess.run([sys.executable, *words[1:], tmp_path / "message"], capture_output=True)
        assert answer.returncode == code
