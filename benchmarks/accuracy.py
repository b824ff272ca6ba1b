"""Run SLAM on sequences × presets × seeds with the command line, and collect accuracy, speed and memory.

Every job is `sigmasplat run` in its own process, with its run folder under runs/bench/. A finished job with the same
code and settings is read, not repeated, unless --fresh. Writes benchmarks/results/<name>-<machine>.json, prints tables.

example: python benchmarks/accuracy.py --sources synthetic redkitchen --seeds 0 1
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

import program
import record
import tables
import tyro

import sigmasplat
from sigmasplat.commands.options import Settings
from sigmasplat.config.find_preset import default_preset, preset as preset_of
from sigmasplat.config.text import override, split_settings
from sigmasplat.errors import SigmaSplatError
from sigmasplat.files.machine import INSTALLED, code_digest

arg = tyro.conf.arg
SYNTHETIC = "synthetic:frames=200"
SOURCES = ("synthetic", "redkitchen", "livingroom", "hololens", "cubicles")
RUNS = record.ROOT / "runs" / "bench"


@dataclass(frozen=True)
class Options:
    """Run SLAM on sequences × presets × seeds and collect accuracy, speed and memory."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = SOURCES
    presets: Annotated[tuple[str, ...], arg(help="preset to start from")] = (default_preset(),)
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run for each")] = (0, 1, 2)
    settings: Settings = ()
    limit: Annotated[int | None, arg(help="number of frames at most", help_behavior_hint="(default: all)")] = None
    name: Annotated[str, arg(help="name of the results; use another name with other --set")] = "accuracy"
    fresh: Annotated[bool, arg(help="repeat runs that exist already")] = False
    runs: Annotated[Path, arg(help="folder of the run folders")] = RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass(frozen=True)
class Job:
    """One run: a sequence by name and path, every setting that changes its result, and a digest of the code."""

    source: str
    path: str
    preset: str
    seed: int
    settings: tuple[str, ...]
    limit: int | None
    code: str

    def key(self) -> dict[str, Any]:
        """Return what must be equal to reuse an earlier result: code, source, every setting."""
        settings = split_settings(self.settings) | {"seed": str(self.seed)}
        config = override(preset_of(self.preset), settings).to_dict()
        return {"code": self.code, "path": self.path, "limit": self.limit, "config": config}

    def folder(self, runs: Path) -> Path:
        """Return the folder of the job's run, log and result; it depends on settings and length."""
        digest = sha256(json.dumps([self.path, self.settings, self.limit]).encode()).hexdigest()[:8]
        return runs / f"{record.slug(self.source)}-{self.preset}-seed{self.seed}-{digest}"

    def command(self, run: Path) -> list[str]:
        """Return the command line of the run."""
        words = [sys.executable, "-m", "sigmasplat.cli", "run", self.path, "--preset", self.preset]
        words += ["--seed", str(self.seed), "--out", str(run), "--overwrite"]
        words += [word for setting in self.settings for word in ("--set", setting)]
        return words + (["--limit", str(self.limit)] if self.limit else [])


def located(name: str) -> str:
    """Return the path of a sequence in the data folder, or the name unchanged if it is not there."""
    if name == "synthetic":
        return SYNTHETIC
    known = record.data_root() / name
    return str(known.resolve()) if known.is_dir() else name


def jobs_of(options: Options) -> list[Job]:
    """List the jobs, source by source. Raises ConfigError for an unknown preset or setting."""
    code = code_digest(Path(sigmasplat.__file__).parent, INSTALLED)
    jobs = [
        Job(Path(source).name, located(source), preset, seed, options.settings, options.limit, code)
        for source in options.sources
        for preset in options.presets
        for seed in options.seeds
    ]
    for job in jobs:
        job.key()
    return jobs


def ended(job: Job, runs: Path) -> dict[str, Any] | None:
    """Return the result of an earlier run of the same job with the same code, also if it failed; None without one."""
    try:
        result = record.read(job.folder(runs) / "result.json")
    except (OSError, ValueError):
        return None
    return result if json.loads(json.dumps(job.key())) == result["key"] else None


def finished(job: Job, runs: Path) -> dict[str, Any] | None:
    """Return the result of an earlier run of the same job with the same code; None without one or if it failed."""
    result = ended(job, runs)
    return result if result and result["problem"] is None else None


def call(command: Sequence[str], output: Path, other: bool = False) -> tuple[str | None, float]:
    """Run a command with its output in a file; return its last line if it failed, and its peak memory, MiB.

    other: whether it is that of another checkout (`program.environment_of`).
    """
    environment = program.environment_of(other)
    with output.open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)
        _, status, usage = os.wait4(process.pid, 0)  # wait4: the peak memory of this child alone
        process.returncode = os.waitstatus_to_exitcode(status)
    return _last_line(output) if process.returncode else None, usage.ru_maxrss / 1024


def perform(job: Job, runs: Path, before: Sequence[str] = ()) -> dict[str, Any]:
    """Run a job and write result.json; for a run that fails, `problem` is its last line.

    `before` is put before the command, for instance to choose cores.
    """
    folder = job.folder(runs)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "result.json").unlink(missing_ok=True)
    start = time.perf_counter()
    problem, peak_mib = call([*before, *job.command(folder / "run")], folder / "output.txt")
    result = {
        "job": asdict(job),
        "key": job.key(),
        **record.commit(),
        "problem": problem,
        "wall_s": round(time.perf_counter() - start, 2),
        "peak_mib": round(peak_mib, 1),
        "figures": {} if problem else figures_of(json.loads((folder / "run" / "metrics.json").read_text())),
    }
    (folder / "result.json").write_text(json.dumps(result, indent=1) + "\n")
    return result


def _last_line(output: Path) -> str:
    lines = [line for line in output.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1][:300] if lines else "no output"


def figures_of(metrics: dict[str, Any]) -> dict[str, float | None]:
    """Return a run's figures from its metrics.json, by the names in `accuracy_tables`; None for a missing one."""
    ate, rpe = metrics.get("ate") or {}, metrics.get("rpe") or {}
    picked: dict[str, float | None] = {
        "ate_m": ate.get("rmse_m"),
        "ate_odometry_m": (metrics.get("ate_odometry") or {}).get("rmse_m"),
        "rpe_m": rpe.get("translation_rmse_m"),
        "rpe_deg": rpe.get("rotation_rmse_deg"),
        **{name: metrics.get(name) for name in ("frames", "keyframes", "lost", "splats", "frames_per_s")},
    }
    for kind in ("held_out", "training"):
        views = metrics.get(kind) or {}
        picked |= {f"{kind}_{name}": views.get(name) for name in ("psnr_db", "ssim", "depth_l1_m")}
    uncertainty = metrics.get("uncertainty") or {}
    return picked | {name: uncertainty.get(name) for name in ("spearman", "ause", "nll")}


def run_all(jobs: list[Job], options: Options) -> list[dict[str, Any]]:
    """Run or read every job, one after the other, with a line on standard error for each."""
    total = len(jobs)
    return [run_one(job, f"{number}/{total}", options.runs, options.fresh) for number, job in enumerate(jobs, 1)]


def run_one(job: Job, number: str, runs: Path, fresh: bool, before: Sequence[str] = ()) -> dict[str, Any]:
    """Run a job (see `perform`), or read its earlier result unless `fresh`; print a line on standard error."""
    earlier = None if fresh else finished(job, runs)
    result = earlier or perform(job, runs, before)
    how = "run before" if earlier else result["problem"] or f"{result['wall_s']:.0f} s"
    print(f"[{number}] {job.source}, {job.preset}, seed {job.seed}: {how}", file=sys.stderr, flush=True)
    return result


def main(options: Options) -> int:
    """Run, write the results, print them; exit code 1 if a job failed, 2 if the options are invalid."""
    try:
        jobs = jobs_of(options)
    except SigmaSplatError as problem:
        return program.refuse("accuracy", problem)
    return publish("accuracy", run_all(jobs, options), options)


def publish(benchmark: str, results: list[dict[str, Any]], options: Any) -> int:
    """Write the results of jobs and print their tables; return 1 if one failed.

    `options` are those of the program, with `name`, `seeds` and the folder `out`.
    """
    kept = [{name: value for name, value in result.items() if name != "key"} for result in results]
    for result in kept:
        result["job"] |= {"path": Path(result["job"]["path"]).name}
    print(tables.table(program.keep(benchmark, {"jobs": kept}, options, options.seeds)))
    return int(any(result["problem"] for result in results))


if __name__ == "__main__":
    program.start(main, Options)
