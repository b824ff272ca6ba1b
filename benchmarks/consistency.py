"""Leave out one part of CG-SLAM's method at a time, on synthetic scenes with sensor noise: the ablation of its paper.

Variants × scenes × seeds, several runs at a time, each on its own core. Then `sigmasplat eval --mesh` compares mesh and
splats with the true surface. Finished runs are reused as in `accuracy.py`.
Writes benchmarks/results/consistency-<machine>.json and prints tables.

example: python benchmarks/consistency.py --scenes room --seeds 0 --jobs 2
"""

import os
import queue
import statistics
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import accuracy
import program
import record
import tyro
from accuracy_tables import failures
from paired_comparison import (
    CHANCE,
    Figure,
    PairedDifference,
    best,
    by_seed,
    difference,
    over_sequences,
    rows,
)
from systems import with_surface
from tables import Section

import sigmasplat
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.files.machine import INSTALLED, code_digest
from sigmasplat.run.figures import number

arg = tyro.conf.arg
SCENES: dict[str, tuple[str, int | None]] = {
    "room": ("synthetic:frames=200,noise=1,seed=1", None),
    "two rooms": ("synthetic:frames=600,rooms=2,noise=1,seed=2", 300),
    "three rooms": ("synthetic:frames=900,rooms=3,noise=1,seed=3", 300),
}
"""Sequence and number of frames: one turn through a room; a path through one doorway; a path through two.

Seeds change patterns, books, plants and noise; the large furniture is the same, mirrored in every second room.
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
"""Settings added to those of --set. "without both" means alignment and variance, as in the paper."""


@dataclass(frozen=True)
class Options:
    """Leave out one part of CG-SLAM's method at a time, on synthetic scenes with sensor noise."""

    scenes: Annotated[tuple[str, ...], arg(help=f"scenes: {', '.join(SCENES)}, or options of a built-in room")] = (
        *SCENES,
    )
    variants: Annotated[tuple[str, ...], arg(help="which ones to run")] = (*VARIANTS,)
    preset: Annotated[str, arg(help="preset to start from")] = "cgslam-fast"
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run for each")] = (0, 1, 2)
    settings: accuracy.Settings = ()
    limit: Annotated[int | None, arg(help="number of frames at most", help_behavior_hint="(default: all)")] = None
    jobs: Annotated[int, arg(help="number of runs at a time, each on one core")] = 1
    name: Annotated[str, arg(help="name of the results; use another name with other --set")] = "consistency"
    fresh: Annotated[bool, arg(help="repeat runs that exist already")] = False
    runs: Annotated[Path, arg(help="folder of the run folders")] = accuracy.RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def jobs_of(options: Options) -> list[tuple[str, accuracy.Job]]:
    """List variant and job, scene by scene. Raises ConfigError for an unknown variant, preset or setting."""
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
    """Return the words that, put before a command, run it on one core with one thread."""
    return ["taskset", "-c", str(core), "env", "OMP_NUM_THREADS=1", "SIGMASPLAT_THREADS=1"]


def cores_of(options: Options) -> "queue.SimpleQueue[int]":
    """Return the cores to run on. Raises ConfigError if --jobs is below 1 or above the number of cores."""
    there = sorted(os.sched_getaffinity(0))
    if not 1 <= options.jobs <= len(there):
        raise ConfigError(f"--jobs {options.jobs}: this machine has {len(there)} cores; give 1 to {len(there)}")
    free: queue.SimpleQueue[int] = queue.SimpleQueue()
    for core in there[: options.jobs]:
        free.put(core)
    return free


def measure(options: Options) -> list[dict[str, Any]]:
    """Run every job, `jobs` at a time, and score its surface; return the results in order, each with its variant.

    Raises ConfigError as `jobs_of` and `cores_of` do.
    """
    listed, free = jobs_of(options), cores_of(options)

    def work(numbered: tuple[int, tuple[str, accuracy.Job]]) -> dict[str, Any]:
        number, (variant, job) = numbered
        core = free.get()
        try:
            label = f"{number}/{len(listed)}, {variant}"
            result = accuracy.run_one(job, label, options.runs, options.fresh, pinned(core))
            return {"variant": variant} | with_surface(job, result, options.runs, pinned(core))
        finally:
            free.put(core)

    with ThreadPoolExecutor(options.jobs) as pool:
        return list(pool.map(work, enumerate(listed, 1)))


# ---- tables ----


Scenes = dict[str, list[dict[str, Any]]]
"""Runs by scene, each with `variant`, `seed` and `figures`."""
FULL = "full"
FIGURES = (
    Figure("ate_m", "ATE", "cm", -1, 100.0),
    Figure("splats_chamfer_m", "Chamfer", "cm", -1, 100.0),
    Figure("splats_accuracy_m", "splats to surface", "cm", -1, 100.0),
    Figure("splats_completion_m", "surface to splats", "cm", -1, 100.0),
    Figure("floaters", "floaters", "%", -1, 100.0),
    Figure("held_out_psnr_db", "PSNR", "dB", +1),
    Figure("held_out_depth_l1_m", "depth L1", "cm", -1, 100.0),
    Figure("splats", "splats", "k", 0, 1e-3, digits=1, judged=False),
    Figure("lost", "lost", "", -1, digits=1, judged=False),
)
JUDGED = tuple(figure for figure in FIGURES if figure.judged)
HEADS = [figure.head for figure in FIGURES]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by consistency.py."""
    results = measured["figures"]["jobs"]
    variants, scenes = list(dict.fromkeys(result["variant"] for result in results)), by_scene(results)
    made = [mean_of(scenes, variants), effects_of(scenes, variants)]
    made += [scene(name, runs, variants) for name, runs in scenes.items()]
    return [section for section in [*made, failures(results)] if section.rows]


def by_scene(results: list[dict[str, Any]]) -> Scenes:
    """Group the successful runs by scene."""
    found: Scenes = {}
    for result in results:
        if result["problem"] is None:
            found.setdefault(result["job"]["source"], []).append(result | {"seed": result["job"]["seed"]})
    return found


def scene(name: str, runs: list[dict[str, Any]], variants: list[str]) -> Section:
    """Tabulate a scene: one row per variant, mean ± standard deviation over its seeds, the best of each column bold."""
    laid_out = rows(runs, variants, lambda text: f"**{text}**", FIGURES)
    return Section(name, ["variant", *HEADS], laid_out, "Mean ± standard deviation over the seeds. Views are held out.")


def mean_of(scenes: Scenes, variants: list[str]) -> Section:
    """Tabulate the mean over scenes of each scene's mean over seeds, for scenes that every variant has."""
    columns = []
    for figure in FIGURES:
        found = [{v: list(by_seed(runs, v, figure).values()) for v in variants} for runs in scenes.values()]
        whole = [by_variant for by_variant in found if all(by_variant.values())]
        means = {v: statistics.fmean(statistics.fmean(b[v]) for b in whole) for v in variants} if whole else {}
        top = best(means, figure)
        columns.append([_marked(number(means[v], figure.digits), v in top) if means else "–" for v in variants])
    laid_out = [[variant, *cells] for variant, *cells in zip(variants, *columns, strict=True)]
    return Section("Mean of scenes", ["variant", *HEADS], laid_out if scenes else [])


def differences(scenes: Scenes, variant: str, figure: Figure) -> list[PairedDifference]:
    """Return the differences of a variant to the full method at equal seeds, scene by scene."""
    found = (difference(runs, variant, FULL, figure) for runs in scenes.values())
    return [of_scene for of_scene in found if of_scene is not None]


def effects_of(scenes: Scenes, variants: list[str]) -> Section:
    """Tabulate the differences to the full method; those that show an effect over the scenes are bold."""
    others = [variant for variant in variants if variant != FULL]
    found = {variant: [differences(scenes, variant, figure) for figure in JUDGED] for variant in others}
    laid_out = [[variant, *map(_effect, changes)] for variant, changes in found.items()]
    note = (
        "Difference to the full method at equal scene and seed: mean ± standard deviation, and how often it is worse. "
        f"Bold: the 95 % t interval of the scenes' means excludes 0; {CHANCE:.0%} of figures do so by chance."
    )
    measured = any(any(changes) for changes in found.values())
    return Section("Effects", ["variant", *(f.title for f in JUDGED)], laid_out if measured else [], note)


def _effect(of_scenes: list[PairedDifference]) -> str:
    if not of_scenes:
        return "–"
    figure = of_scenes[0].figure
    pairs = PairedDifference(figure, tuple(change for scene in of_scenes for change in scene.each))
    worse = sum(figure.better * change < 0 for change in pairs.each)
    return f"{_marked(pairs.written(), over_sequences(of_scenes).stands_out)}, {worse}/{len(pairs.each)}"


def _marked(text: str, stands_out: bool) -> str:
    return f"**{text}**" if stands_out else text


def main(options: Options) -> int:
    """Run, score, write the results, print them; exit code 1 if a job failed, 2 if the options are invalid."""
    try:
        results = measure(options)
    except SigmaSplatError as problem:
        return program.refuse("consistency", problem)
    return accuracy.publish("consistency", results, options)


if __name__ == "__main__":
    program.start(main, Options, __doc__)
