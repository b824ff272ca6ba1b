"""Leave out one part of the consistent field at a time, on synthetic scenes with a sensor's noise: CG-SLAM's ablation.

Variants × scenes × seeds, several runs at once, each on one core of its own. Then `sigmasplat eval --mesh` holds mesh
and splats against the true surface. Runs are kept as `accuracy.py` keeps them, and read where they were run before.
Writes benchmarks/results/consistency-<machine>.json, prints tables.

example: python benchmarks/consistency.py --scenes room --seeds 0 --jobs 2
"""

import os
import queue
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import accuracy
import record
import tyro
from systems import with_surface

import sigmasplat
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.io.machine import INSTALLED, code_digest

arg = tyro.conf.arg
SCENES: dict[str, tuple[str, int | None]] = {
    "room": ("synthetic:frames=200,noise=1,seed=1", None),
    "two rooms": ("synthetic:frames=600,rooms=2,noise=1,seed=2", 300),
    "three rooms": ("synthetic:frames=900,rooms=3,noise=1,seed=3", 300),
}
"""Sequence, and how many of its frames: one turn across a room; the way out through one doorway; through two.

Seeds change patterns, books, plants and noise; the large furniture stays, mirrored in every second room.
"""
ALIGNMENT, VARIANCE = "mapping.weight_alignment=0", "mapping.weight_moment=0"
VARIANTS: dict[str, tuple[str, ...]] = {
    "full": (),
    "without alignment": (ALIGNMENT,),
    "without variance": (VARIANCE,),
    "without both": (ALIGNMENT, VARIANCE),
    "without isotropy": ("mapping.weight_isotropy_ratio=0",),
    "without primitive uncertainty": ("primitives.uncertain_m2=0",),
}
"""Settings over those of --set; both: alignment and variance, as in the paper."""


@dataclass(frozen=True)
class Options:
    """Leave out one part of the consistent field at a time, on synthetic scenes with a sensor's noise."""

    scenes: Annotated[tuple[str, ...], arg(help=f"of {', '.join(SCENES)}; or a built-in room's options")] = (*SCENES,)
    variants: Annotated[tuple[str, ...], arg(help="which of them")] = (*VARIANTS,)
    preset: Annotated[str, arg(help="settings to start from")] = "cgslam-fast"
    seeds: Annotated[tuple[int, ...], arg(help="starts of the random numbers, a run each")] = (0, 1, 2)
    settings: accuracy.Settings = ()
    limit: Annotated[int | None, arg(help="take at most so many frames", help_behavior_hint="(default: all)")] = None
    jobs: Annotated[int, arg(help="runs at once, each on one core")] = 1
    name: Annotated[str, arg(help="name of the results; another one for other --set")] = "consistency"
    fresh: Annotated[bool, arg(help="run also what has been run before")] = False
    runs: Annotated[Path, arg(help="folder of the run folders")] = accuracy.RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def jobs_of(options: Options) -> list[tuple[str, accuracy.Job]]:
    """List variant and job, scene by scene. Raises ConfigError on an unknown variant, preset or setting."""
    unknown = [name for name in options.variants if name not in VARIANTS]
    if unknown:
        raise ConfigError(f"no variant {unknown[0]!r}; there are {', '.join(VARIANTS)}")
    code = code_digest(Path(sigmasplat.__file__).parent, INSTALLED)
    listed = []
    for scene in options.scenes:
        path, most = SCENES.get(scene, (scene, None))
        limit = min(filter(None, (most, options.limit)), default=None)
        for seed in options.seeds:
            for variant in options.variants:
                settings = (*options.settings, *VARIANTS[variant])
                listed.append((variant, accuracy.Job(scene, path, options.preset, seed, settings, limit, code)))
    for _, job in listed:
        job.key()
    return listed


def pinned(core: int) -> list[str]:
    """Return the words before a command that keep it on one core with one thread."""
    return ["taskset", "-c", str(core), "env", "OMP_NUM_THREADS=1", "SIGMASPLAT_THREADS=1"]


def cores_of(options: Options) -> "queue.SimpleQueue[int]":
    """Return the cores to run on. Raises ConfigError unless there are as many as --jobs asks for, and it for one."""
    there = sorted(os.sched_getaffinity(0))
    if not 1 <= options.jobs <= len(there):
        raise ConfigError(f"--jobs {options.jobs}: this machine has {len(there)} cores; give 1 to {len(there)}")
    free: queue.SimpleQueue[int] = queue.SimpleQueue()
    for core in there[: options.jobs]:
        free.put(core)
    return free


def measure(options: Options) -> list[dict[str, Any]]:
    """Run every job, so many at once, and score its surface; results in the order of the jobs, each with its variant.

    Raises ConfigError as `jobs_of` and `cores_of` do.
    """
    listed, free = jobs_of(options), cores_of(options)

    def work(numbered: tuple[int, tuple[str, accuracy.Job]]) -> dict[str, Any]:
        number, (variant, job) = numbered
        core = free.get()
        try:
            told = f"{number}/{len(listed)}, {variant}"
            result = accuracy.run_one(job, told, options.runs, options.fresh, pinned(core))
            return {"variant": variant} | with_surface(job, result, options.runs, pinned(core))
        finally:
            free.put(core)

    with ThreadPoolExecutor(options.jobs) as pool:
        return list(pool.map(work, enumerate(listed, 1)))


def main(options: Options) -> int:
    """Run, score, write, print; exit code 1 if a job failed, 2 if the options mean nothing."""
    try:
        results = measure(options)
    except SigmaSplatError as problem:
        print(f"consistency.py: {problem}", file=sys.stderr)
        return 2
    return accuracy.publish("consistency", results, options)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__, config=(tyro.conf.FlagCreatePairsOff,))))
