"""Measure the effect of loop closure: complete runs with and without it, every loop compared with the truth (issue 4).

drift: synthetic rooms with a drifting depth error, and the same run without its loops. real: redkitchen in submaps with
loops, and in one submap. `accuracy.py` makes the runs and reuses finished ones.
Writes benchmarks/results/loops-<machine>.json and prints tables; benchmarks/README.md says what each figure means.

example: python benchmarks/loops.py --experiments drift
"""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import accuracy
import numpy as np
import program
import record
import tyro
from loops_tables import FALSE_ROTATION_DEG, FALSE_TRANSLATION_M
from numpy.typing import NDArray
from tracking import true_poses

import sigmasplat
from sigmasplat.config import SubmapConfig
from sigmasplat.config.find_preset import default_preset
from sigmasplat.data import se3
from sigmasplat.errors import SigmaSplatError, SourceError
from sigmasplat.files.machine import INSTALLED, code_digest
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
Matrix = NDArray[np.float64]
Records = list[dict[str, Any]]
Experiment = Literal["drift", "real"]
DRIFTING = "synthetic:frames=720,rooms=2,overrun=20,noise=1,drift=6"
"""`sigmasplat.plugins.sources.synthetic.SyntheticRoom` gives the reason for this path."""
ONE_SUBMAP = tuple(f"submaps.{field.name}=0" for field in fields(SubmapConfig))
WAYS: dict[Experiment, dict[str, tuple[str, ...]]] = {
    "drift": {"loops": ("loops.close=true",)},
    "real": {"loops": (), "one submap": ONE_SUBMAP},
}
"""The settings compared in each experiment, added to those of --set.

The preset itself closes loops, so its runs of the real sequence are those of accuracy.py.
"""
QUICK = (",width=160,height=120", "input.width=160")


@dataclass(frozen=True)
class Options:
    """Measure the effect of loop closure: complete runs with and without it, every loop compared with the truth."""

    experiments: Annotated[tuple[Experiment, ...], arg(help="which ones to run")] = ("drift", "real")
    source: Annotated[str, arg(help="sequence for the drift experiment, without a seed; each run adds its own")] = (
        DRIFTING
    )
    seeds: Annotated[tuple[int, ...], arg(help="seeds of the drift experiment, for room, noise and run")] = (
        0,
        1,
        2,
        3,
        4,
    )
    real: Annotated[str, arg(help="real sequence: name or path")] = "redkitchen"
    real_seeds: Annotated[tuple[int, ...], arg(help="seeds of the runs on the real sequence")] = (0, 1, 2)
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: accuracy.Settings = ()
    quick: Annotated[
        bool, arg(help="some minutes: one seed of the drift experiment at half width, no results written")
    ] = False
    name: Annotated[str, arg(help="name of the results")] = "loops"
    fresh: Annotated[bool, arg(help="repeat runs that exist already")] = False
    runs: Annotated[Path, arg(help="folder of the run folders")] = accuracy.RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def shortened(options: Options) -> Options:
    """Return the options for --quick."""
    width, setting = QUICK
    short = replace(options, experiments=("drift",), seeds=options.seeds[:1], source=options.source + width)
    return replace(short, settings=(*options.settings, setting))


def jobs_of(options: Options) -> list[tuple[Experiment, str, accuracy.Job]]:
    """List experiment, variant and job, seed by seed. Raises ConfigError for an unknown preset or setting."""
    code = code_digest(Path(sigmasplat.__file__).parent, INSTALLED)
    listed: list[tuple[Experiment, str, accuracy.Job]] = []
    for experiment in options.experiments:
        for seed in options.seeds if experiment == "drift" else options.real_seeds:
            if experiment == "drift":
                name, path = "drift", f"{options.source},seed={seed}"
            else:
                name, path = Path(options.real).name, accuracy.located(options.real)
            for way, changes in WAYS[experiment].items():
                settings = (*options.settings, *changes)
                listed.append((experiment, way, accuracy.Job(name, path, options.preset, seed, settings, None, code)))
    for _, _, job in listed:
        job.key()
    return listed


def submap_starts(log: Records) -> dict[int, dict[str, Any]]:
    """Return the first log line of each submap: its first keyframe, whose camera defines the submap's coordinates."""
    starts: dict[int, dict[str, Any]] = {}
    for line in log:
        starts.setdefault(line["submap"], line)
    return starts


def judged(loop: dict[str, Any], T_world_query: Matrix, T_world_database: Matrix) -> dict[str, Any]:
    """Return a loop's record with its error relative to the true poses [4, 4] of both submaps, without its matrix."""
    T_true = se3.inverse(T_world_query) @ T_world_database
    error = se3.inverse(T_true) @ np.array(loop["T_query_database"], np.float64)
    error_m = float(np.linalg.norm(error[:3, 3]))
    error_deg = float(np.degrees(se3.rotation_angle(error[:3, :3])))
    true = error_m <= FALSE_TRANSLATION_M and error_deg <= FALSE_ROTATION_DEG
    kept = {name: value for name, value in loop.items() if name != "T_query_database"}
    return kept | {"error_m": round(error_m, 4), "error_deg": round(error_deg, 3), "true": true}


def judge_all(loops: Records, log: Records, T_world_camera: Matrix) -> Records:
    """Compare loops with the true poses [F, 4, 4] of the logged frames, in the order of the log."""
    rows = {line["index"]: row for row, line in enumerate(log)}
    starts = {submap: T_world_camera[rows[line["index"]]] for submap, line in submap_starts(log).items()}
    return [judged(loop, starts[loop["query"]], starts[loop["database"]]) for loop in loops]


def described(run: RunFolder, path: str, wanted: bool) -> dict[str, Any]:
    """Return the number of submaps and of tried loops of a run, and its registered loops compared with the truth.

    If not `wanted`, there are no loops. Raises SourceError if a loop's frames have no true pose, SigmaSplatError or
    OSError if the run's files are damaged.
    """
    log = run.read_log()
    submaps = len({line.get("submap", 0) for line in log})
    if not wanted:
        return {"submaps": submaps, "tried": 0, "loops": []}
    tried: Any = record.read(run.path / "loops.json")
    registered = [loop for loop in tried if loop["accepted"] or loop["chi2"] is not None]
    needed = sorted(submap_starts(log).values(), key=lambda line: int(line["index"]))
    truth = true_poses(open_source(path), [line["timestamp_s"] for line in needed])
    return {"submaps": submaps, "tried": len(tried), "loops": judge_all(registered, needed, truth)}


def measure(options: Options) -> Records:
    """Run every job and describe it; a run that failed, or whose loops cannot be read, has a `problem`."""
    listed, results = jobs_of(options), []
    wanted = accuracy.Options(fresh=options.fresh, runs=options.runs)
    for (experiment, way, job), result in zip(
        listed, accuracy.run_all([job for *_, job in listed], wanted), strict=True
    ):
        made: dict[str, Any] = {"experiment": experiment, "source": job.source, "way": way, "seed": job.seed}
        made |= {name: result[name] for name in ("problem", "wall_s", "peak_mib", "figures")}
        if result["problem"] is None:
            try:
                made |= described(RunFolder.open(job.folder(options.runs) / "run"), job.path, way == "loops")
            except (SigmaSplatError, OSError, ValueError, KeyError) as problem:
                made["problem"] = f"{type(problem).__name__}: {problem}"
        results.append(made)
    return results


def checked(options: Options) -> None:
    """Raise SourceError if the sequence of the drift experiment cannot be read with the chosen seeds."""
    if "drift" in options.experiments and ",seed=" in options.source:
        raise SourceError(f"--source {options.source} has a seed; each run adds its own, give --seeds")
    for seed in options.seeds if "drift" in options.experiments else ():
        open_source(f"{options.source},seed={seed}")


def measure_all(options: Options) -> dict[str, Any]:
    """Check the options, then measure."""
    checked(options)
    return {"jobs": measure(options)}


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    if options.quick:
        options = shortened(options)
    name = Path(options.real).name
    return program.run("loops", options, measure_all, options.seeds, not options.quick, real=name)


if __name__ == "__main__":
    program.start(main, Options)
