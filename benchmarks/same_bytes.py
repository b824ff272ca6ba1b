"""Compare what runs of this checkout and of another commit compute, value by value: path, map, submaps, loops, metrics.

Each run of same_bytes_cases.py is a process of one thread. The other commit's code and results are kept in
build/before/ (checkouts.py), so that a second comparison with it runs this checkout only, whose results are in
runs/same-bytes/. Prints for each run what differs; exit code 1 if something does.

example: python benchmarks/same_bytes.py HEAD~3 --only redkitchen,sigma varsplat
"""

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from typing import Annotated

import checkouts
import program
import record
import tyro
from same_bytes_cases import CASES, RENAMED, SPELLED_BEFORE
from same_bytes_results import DONE, differences, read_run

from sigmasplat.errors import ConfigError, RunError, SigmaSplatError
from sigmasplat.files import machine

arg = tyro.conf.arg
NOW = record.ROOT / "runs" / "same-bytes"
NOT_KEPT = ("report.html", "images")
REFUSED = 2
"""Exit code of a command whose words are wrong."""


@dataclass(frozen=True)
class Options:
    """Compare what runs of this checkout and of another commit compute, value by value."""

    before: Annotated[tyro.conf.Positional[str], arg(help="the other commit, as git names it")]
    only: Annotated[tuple[str, ...], arg(help="runs whose name has this text, or all of several texts a,b")] = ()
    jobs: Annotated[int, arg(help="number of runs at a time")] = 2
    rename: Annotated[tuple[str, ...], arg(help="old=new: a key or file of the results; old=: leave it out")] = ()


@dataclass(frozen=True)
class Ran:
    """A finished run: folder, processor time in seconds, and why it failed or None."""

    folder: Path
    cpu_s: float
    problem: str | None = None


def chosen(only: Sequence[str]) -> list[str]:
    """Return the names of the runs that `only` selects, all if it is empty. Raises ConfigError for text in none."""
    for text in only:
        if not any(_has(name, text) for name in CASES):
            raise ConfigError(f"no run has {text!r} in its name; the runs are {', '.join(CASES)}")
    return [name for name in CASES if not only or any(_has(name, text) for text in only)]


def _has(name: str, text: str) -> bool:
    return all(part in name for part in text.split(","))


def renames(given: Sequence[str]) -> dict[str, str]:
    """Return the announced renames and those of the command line. Raises ConfigError for one without =."""
    wrong = [text for text in given if not text.partition("=")[0] or "=" not in text]
    if wrong:
        raise ConfigError(f"--rename {wrong[0]} has no old=new; give for instance --rename tracking.doubtful=doubtful")
    return RENAMED | dict(text.split("=", 1) for text in given)


def spelled_before(words: str) -> str:
    """Return the words of a run as the other commit has them."""
    for now, before in SPELLED_BEFORE.items():
        words = words.replace(now, before)
    return words


def command_words(words: str) -> list[str]:
    """Return the words of `sigmasplat run`, with the path of a recording. Raises ConfigError if it is missing."""
    source, *others = words.split()
    if not source.startswith("synthetic"):
        path = record.data_root() / source
        if not path.is_dir():
            raise ConfigError(f"no recording {path}; set SIGMASPLAT_DATA to the folder that holds {source}/")
        source = str(path.resolve())
    return ["run", source, *others]


def run(tree: Path, words: Sequence[str], folder: Path) -> tuple[int, Ran]:
    """Run a tree's `sigmasplat` with new results in `folder`; return its exit code and the run."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    output = folder.with_suffix(".output")
    with output.open("w") as log:
        process = subprocess.Popen(
            [*checkouts.command(), *words, "--out", str(folder)],
            env=checkouts.environment(tree), stdout=log, stderr=subprocess.STDOUT,
        )  # fmt: skip
        _, status, usage = os.wait4(process.pid, 0)  # wait4: the time of this child alone
        process.returncode = os.waitstatus_to_exitcode(status)
    last = [line for line in output.read_text(errors="replace").splitlines() if line.strip()][-1:]
    output.unlink()
    problem = (last or ["no message"])[0][:300] if process.returncode else None
    for name in NOT_KEPT:
        shutil.rmtree(folder / name, ignore_errors=True)
        (folder / name).unlink(missing_ok=True)
    return process.returncode, Ran(folder, usage.ru_utime + usage.ru_stime, problem)


def run_before(name: str, commit: str, tree: Path) -> Ran:
    """Return a run of the other commit, which is made once on each kind of machine and then kept, unless it fails."""
    spellings = dict.fromkeys([spelled_before(CASES[name]), CASES[name]])
    for words in spellings:
        folder = kept_folder(name, commit, words)
        if (folder / DONE).is_file():
            return Ran(folder, json.loads((folder / DONE).read_text())["cpu_s"])
        code, ran = run(tree, command_words(words), folder)
        if code != REFUSED:
            break
    if ran.problem is None:
        (folder / DONE).write_text(json.dumps({"words": words, "cpu_s": round(ran.cpu_s, 2)}) + "\n")
    return ran


def kept_folder(name: str, commit: str, words: str) -> Path:
    """Return the folder of a kept run, which depends on its words, the machine, and the version of torch."""
    conditions = json.dumps([words, machine.describe(), metadata.version("torch")], sort_keys=True)
    return checkouts.folder_of(commit) / "same-bytes" / f"{name}-{sha256(conditions.encode()).hexdigest()[:8]}"


def compare(name: str, commit: str, tree: Path, renamed: dict[str, str]) -> tuple[bool, str, float, float]:
    """Run both sides; return whether they agree, in words what differs, and the processor times before and now."""
    before = run_before(name, commit, tree)
    _, now = run(record.ROOT, command_words(CASES[name]), NOW / name)
    failed = [f"{side} fails: {ran.problem}" for side, ran in (("before", before), ("now", now)) if ran.problem]
    if failed:
        return False, "\n".join(f"    {line}" for line in failed), before.cpu_s, now.cpu_s
    sides = [read_run(ran.folder, renamed) for ran in (before, now)]
    if not all(sides):
        return False, "    a side has no results", before.cpu_s, now.cpu_s
    found = differences(*sides)
    lines = [f"    {file}: {said}" for file, said in found.items()]
    return not lines, "\n".join(lines), before.cpu_s, now.cpu_s


def main(options: Options) -> int:
    """Run and compare; exit code 1 if a run differs or fails, 2 if the options are invalid."""
    try:
        names, renamed = chosen(options.only), renames(options.rename)
        for name in names:
            command_words(CASES[name])
        if options.jobs < 1:
            raise ConfigError(f"--jobs is at least 1, found {options.jobs}")
        if not checkouts.built(record.ROOT):
            raise RunError(f"{record.ROOT} has no kernels as new as their sources; compile them with make native")
        commit = checkouts.commit_of(options.before)
        tree = checkouts.checkout(options.before)
    except SigmaSplatError as problem:
        return program.refuse("same_bytes", problem)
    different, spent = [], [0.0, 0.0]
    with ThreadPoolExecutor(options.jobs) as pool:
        compared = pool.map(lambda name: compare(name, commit, tree, renamed), names)
        for name, (same, said, *cpu_s) in zip(names, compared, strict=True):
            spent = [total + more for total, more in zip(spent, cpu_s, strict=True)]
            different += [] if same else [name]
            print(f"{'same' if same else 'DIFFERENT'}  {name}  ({cpu_s[0]:.1f} → {cpu_s[1]:.1f} CPU s)")
            print(said, end="\n" if said else "", flush=True)
    total = f"CPU time {spent[0]:.0f} → {spent[1]:.0f} s, of {commit[:9]} as it was measured"
    print(f"{len(names) - len(different)} of {len(names)} runs are the same as those of {commit[:9]}; {total}")
    if different:
        print(f"different: {', '.join(different)}; the results are in {checkouts.folder_of(commit)} and {NOW}")
    return int(bool(different))


if __name__ == "__main__":
    program.start(main, Options, __doc__)
