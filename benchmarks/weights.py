"""Measure what each use of an uncertainty changes: V as published, no weights, CG-SLAM's terms.

Sequences × seeds × variants of `sigma`, one value of τ for all. Every 8th frame is held back from the map and scored.
Of the default run, registrations of its submaps, the gate of loop candidates and final maps are measured as well.
Finished jobs are kept in runs/bench/weights/NAME.jsonl and are not repeated while code and settings are unchanged.
Writes benchmarks/results/<name>-<machine>.json; `python benchmarks/tables.py` writes its tables into the documents.

example: python benchmarks/weights.py --sources cubicles --seeds 0 1 --variants default "tracking: no weights"
"""

import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import ablation
import program
import record
import tables
import tyro

import sigmasplat
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override, split_settings
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.files.machine import INSTALLED, code_digest

arg = tyro.conf.arg
SEQUENCES: dict[str, tuple[str, ...]] = {
    "synthetic": ("input.limit=120",),
    "livingroom": ("input.stride=2", "input.limit=120"),
    "redkitchen": ("input.stride=4", "input.limit=120"),
    "hololens": ("input.limit=90",),
    "cubicles": (),
}
"""Settings of each sequence: at most 120 frames. A stride covers more of a slow recording, so that there are loops."""
SYNTHETIC = "synthetic:frames=120,overrun=20,noise=1,drift=6,seed={seed}"
"""A different room for each seed, a sensor that drifts, and a path that ends where it began."""
COMMON = (
    "input.width=240", "input.hold_every=8", "uncertainty.probes=0", "final.iterations=250",
    "tracking.tau=10", "loops.tau=10", "registration.tau=10", "tracking.uncertainty=true", "mapping.weight_moment=0.1",
)  # fmt: skip
"""Settings of all runs; --set adds to them. `sigma` has no V in tracking and no U in the loss."""
DEFAULT = "default"
"""The run with all uncertainties, of which the maps are measured too."""
NO_WEIGHTS = tuple(f"{part}.uncertainty=false" for part in ("tracking", "loops", "registration", "final"))
PATH: dict[str, tuple[str, ...]] = {
    "no weights at all": NO_WEIGHTS,
    "tracking: no weights": ("tracking.uncertainty=false",),
    "tracking: depth by U": ("tracking.align_depth_by=U",),
    "mapping: no U": ("mapping.weight_moment=0",),
    "mapping: with alignment": ("mapping.weight_alignment=0.25",),
    "pruning: no fading": ("primitives.uncertain_m2=0",),
}
"""Settings of the complete runs that are compared with `default`: V as published in every weight, U in the
loss, and fading."""
TAU_2 = ("registration.tau=2", "loops.tau=2")
WEIGHTS: dict[str, tuple[str, ...]] = {
    "V": (),
    "no weights": NO_WEIGHTS,
    "V, τ 2": TAU_2,
}
"""Settings of what is measured of the maps of the default run."""
RUNS = record.ROOT / "runs" / "bench" / "weights"


@dataclass(frozen=True)
class Options:
    """Measure what each use of an uncertainty changes."""

    sources: Annotated[tuple[str, ...], arg(help="sequences")] = (*SEQUENCES,)
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run for each")] = (0, 1, 2, 3, 4)
    variants: Annotated[tuple[str, ...], arg(help="complete runs to make")] = (DEFAULT, *PATH)
    settings: Annotated[tuple[str, ...], arg(name="set", help="settings of all runs")] = ()
    jobs: Annotated[int, arg(help="number of runs at a time, each with one thread")] = 1
    any_code: Annotated[bool, arg(help="reuse finished jobs of other code too")] = False
    collect: Annotated[bool, arg(help="make no run; write the results of the finished jobs")] = False
    name: Annotated[str, arg(help="name of the results; use another name with other --set")] = "weights"
    runs: Annotated[Path, arg(help="folder of finished jobs")] = RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass(frozen=True)
class Job:
    """One run: sequence, seed, variant (a name of `PATH`, or the default), and all settings."""

    source: str
    seed: int
    variant: str
    settings: tuple[str, ...]

    @property
    def path(self) -> str:
        """Return the source to open."""
        at = SYNTHETIC if self.source == "synthetic" else ablation.located(self.source)
        return at.replace("{seed}", str(self.seed))

    def config(self, more: tuple[str, ...] = ()) -> Config:
        """Return all settings. Raises ConfigError for an unknown one."""
        changed = split_settings([*self.settings, *more, f"seed={self.seed}"])
        return override(preset(default_preset()), changed)


def jobs_of(options: Options) -> list[Job]:
    """List the jobs seed by seed, so that an unfinished benchmark has every variant of its first seeds.

    Raises ConfigError for an unknown variant.
    """
    known = {DEFAULT: (), **PATH}
    unknown = [name for name in options.variants if name not in known]
    if unknown:
        raise ConfigError(f"no variant {unknown[0]!r}; there are {', '.join(known)}")
    return [
        Job(source, seed, variant, (*COMMON, *SEQUENCES.get(source, ()), *options.settings, *known[variant]))
        for seed in options.seeds
        for variant in options.variants
        for source in options.sources
    ]


def measured(job: Job) -> dict[str, Any]:
    """Make a job's run; return its rows: group, variant and figures each."""
    import weights_runs

    start = time.perf_counter()
    found = weights_runs.rows(job, WEIGHTS if job.variant == DEFAULT else {})
    return {"job": asdict(job), "code": digest(), **record.commit(), "rows": found,
            "wall_s": round(time.perf_counter() - start, 1)}  # fmt: skip


def digest() -> str:
    """Return what identifies the code that runs."""
    return code_digest(Path(sigmasplat.__file__).parent, INSTALLED)


def finished(options: Options) -> dict[str, dict[str, Any]]:
    """Return the results of finished jobs by job; those of other code only with --any-code."""
    file, code = options.runs / f"{record.slug(options.name)}.jsonl", digest()
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    found = [json.loads(line) for line in lines]
    return {key(Job(**result["job"])): result for result in found if options.any_code or result["code"] == code}


def key(job: Job) -> str:
    """Return what identifies a job in the file."""
    return json.dumps(asdict(job), sort_keys=True)


def measure(options: Options) -> dict[str, Any]:
    """Make the missing runs, `jobs` at a time, and store each at once; return the rows of all jobs."""
    listed, done = jobs_of(options), finished(options)
    missing = [] if options.collect else [job for job in listed if key(job) not in done]
    for result in _results(missing, options.jobs):
        options.runs.mkdir(parents=True, exist_ok=True)
        with (options.runs / f"{record.slug(options.name)}.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(result, allow_nan=False) + "\n")
        job = Job(**{**result["job"], "settings": tuple(result["job"]["settings"])})
        done[key(job)] = result
        made = sum(key(one) in done for one in listed)
        print(f"{made}/{len(listed)} {job.source}, {job.variant}, seed {job.seed}: {result['wall_s']} s", flush=True)
    return {"runs": [run for job in listed if key(job) in done for run in _runs(done[key(job)])]}


def _results(jobs: list[Job], at_a_time: int) -> Iterator[dict[str, Any]]:
    os.environ.update(SIGMASPLAT_THREADS="1", OMP_NUM_THREADS="1")
    with ProcessPoolExecutor(at_a_time, get_context("spawn")) as pool:
        yield from pool.map(measured, jobs)


def _runs(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a finished job with its sequence, seed and commit."""
    job = result["job"]
    return [{"source": job["source"], "seed": job["seed"], "commit": result["commit"]} | row for row in result["rows"]]


def main(options: Options) -> int:
    """Run, write the results, print them; exit code 2 if the options are invalid."""
    try:
        figures = measure(options)
    except SigmaSplatError as problem:
        return program.refuse("weights", problem)
    print(tables.table(program.keep("weights", figures, options, options.seeds)))
    return 0


if __name__ == "__main__":
    program.start(main, Options, __doc__)
