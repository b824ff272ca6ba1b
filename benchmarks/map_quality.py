"""Compare the maps of two checkouts: image quality, depth, path, size, memory and time of the final map.

Sequences × seeds; each run is a process that scores itself, on views that are not keyframes. `--before` names the
sigmasplat of another checkout, which is measured beside this one. Finished runs are read, not repeated, unless --fresh.
Writes benchmarks/results/<name>-<machine>.json and prints tables.

example: python benchmarks/map_quality.py --before ../before/.venv/bin/sigmasplat --seeds 0
"""

import json
import shlex
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from numpy.typing import NDArray
from tables import Section, significant

import sigmasplat
from sigmasplat.commands.options import Settings
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.files.machine import INSTALLED, code_digest
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
SYNTHETIC = "synthetic:frames=200,noise=1"
SEQUENCES = ("redkitchen", "livingroom", "hololens", "cubicles", "synthetic")
SPIKE_RATIO, SPIKE_PX = 20.0, 20.0
"""A spike is a splat whose longest axis is this many times the second, and this long (2 σ) in the nearest keyframe."""
CELL_M = 0.05
"""The surface of a map is its number of cells of this size with an opaque splat, times the area of a side."""
RUNS = record.ROOT / "runs" / "map_quality"
FIGURES = {
    "psnr_db": ("PSNR, dB", 1.0), "psnr_submaps_db": ("in submaps, dB", 1.0), "ssim": ("SSIM", 1.0),
    "ssim_submaps": ("in submaps", 1.0), "depth_l1_m": ("depth L1, cm", 100.0),
    "depth_l1_submaps_m": ("in submaps, cm", 100.0), "ate_m": ("ATE, cm", 100.0), "splats": ("splats, 1000", 1e-3),
    "map_bytes": ("map, MB", 1e-6), "bytes_per_m2": ("MB/m²", 1e-6), "peak_rss_bytes": ("peak RAM, MB", 1e-6),
    "finish_s": ("final map, s", 1.0), "spikes": ("spikes, ‰", 1e3),
}  # fmt: skip
"""Figures of a run: heading and factor."""


@dataclass(frozen=True)
class Options:
    """Compare the maps of two checkouts: image quality, depth, path, size, memory and time of the final map."""

    sequences: Annotated[tuple[str, ...], arg(help="names in the data folder, or paths")] = SEQUENCES
    seeds: Annotated[tuple[int, ...], arg(help="seeds, one run for each")] = (0, 1, 2)
    before: Annotated[str, arg(help="sigmasplat of another checkout", help_behavior_hint="(default: none)")] = ""
    limit: Annotated[int, arg(help="use at most this many frames; 0 = all")] = 0
    hold_out: Annotated[
        int, arg(help="score every N-th frame, which is never mapped (input.hold_every; new checkouts only)",
                 help_behavior_hint="(default: 0 = frames that are not keyframes)")
    ] = 0  # fmt: skip
    settings: Settings = ()
    name: Annotated[str, arg(help="name of the results")] = "map-quality"
    fresh: Annotated[bool, arg(help="repeat runs that exist already")] = False
    runs: Annotated[Path, arg(help="folder of finished runs")] = RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass(frozen=True)
class Job:
    """One run: sequence, seed, and which code makes it ("now" or "before")."""

    sequence: str
    seed: int
    code: str
    command: tuple[str, ...]
    digest: str

    def words(self, options: Options, run: Path) -> list[str]:
        """Return the command line of the run."""
        path = SYNTHETIC if self.sequence == "synthetic" else accuracy.located(self.sequence)
        words = [*self.command, "run", path, "--seed", str(self.seed), "--out", str(run), "--overwrite"]
        words += ["--set", f"input.hold_every={options.hold_out}"] if options.hold_out else []
        words += ["--limit", str(options.limit)] if options.limit else []
        return words + [word for setting in options.settings for word in ("--set", setting)]


def jobs_of(options: Options) -> list[Job]:
    """List the runs: for each sequence and seed, this checkout and the one before take turns."""
    digest = code_digest(Path(sigmasplat.__file__).parent, INSTALLED)
    codes = [("now", (sys.executable, "-m", "sigmasplat.cli"), digest)]
    if options.before:
        codes.append(("before", tuple(shlex.split(options.before)), options.before))
    return [
        Job(sequence, seed, *code) for seed in options.seeds for sequence in options.sequences for code in codes
    ]  # fmt: skip


def measured_run(job: Job, options: Options) -> dict[str, Any]:
    """Return the figures of a run, of a finished one if it had the same code and command line."""
    folder = options.runs / f"{record.slug(Path(job.sequence).name)}-{job.code}-seed{job.seed}"
    kept, words = folder / "figures.json", job.words(options, folder / "run")
    made_by = {"words": words[len(job.command) :], "digest": job.digest}
    if kept.is_file() and not options.fresh and (known := json.loads(kept.read_text()))["made_by"] == made_by:
        return dict(known["figures"])
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    figures: dict[str, Any] = {"sequence": Path(job.sequence).name, "seed": job.seed, "code": job.code}
    print(shlex.join(words), file=sys.stderr)
    problem, peak_mib = accuracy.call(words, folder / "output.txt", other=job.code != "now")
    if problem is not None:
        return figures | {"problem": (folder / "output.txt").read_text()[-500:]}
    figures |= figures_of(RunFolder(folder / "run")) | {"peak_rss_bytes": int(peak_mib * 1024**2)}
    kept.write_text(json.dumps({"made_by": made_by, "figures": figures}, indent=1))
    shutil.rmtree(folder / "run" / "submaps", ignore_errors=True)
    return figures


def figures_of(run: RunFolder) -> dict[str, Any]:
    """Return the figures of a finished and scored run."""
    metrics, field = run.read_metrics(), run.read_map()
    held, submaps = metrics["held_out"], metrics.get("held_out_submaps") or {}
    surface_m2 = surface_area_m2(field)
    names = {"psnr_db": "psnr_db", "ssim": "ssim", "depth_l1_m": "depth_l1_m"}
    in_submaps = {"psnr_submaps_db": "psnr_db", "ssim_submaps": "ssim", "depth_l1_submaps_m": "depth_l1_m"}
    return {
        **{name: held.get(key) for name, key in names.items()},
        **{name: submaps.get(key) for name, key in in_submaps.items()},
        **{name: metrics.get(name) for name in ("splats", "map_bytes", "finish_s")},
        "ate_m": (metrics.get("ate") or {}).get("rmse_m"),
        "surface_m2": surface_m2,
        "bytes_per_m2": metrics["map_bytes"] / surface_m2 if surface_m2 else None,
        "spikes": spike_share(field, *keyframe_views(run)),
    }


def surface_area_m2(field: GaussianField) -> float:
    """Return about how much surface a map covers: its occupied cells times the area of a side."""
    opaque = field.means[field.opacities > 0.5].numpy()
    return len(np.unique(np.floor(opaque / CELL_M), axis=0)) * CELL_M**2


def keyframe_views(run: RunFolder) -> tuple[NDArray[np.float64], float]:
    """Return the poses T_world_camera [K, 4, 4] of a run's keyframes, and the focal length of its working images."""
    tensors, _ = run.read_checkpoint()
    camera = run.submaps.load(0).camera
    return np.asarray(tensors["T_world_camera"][tensors["keyframes"]], np.float64), camera.fx


def spike_share(field: GaussianField, T_world_camera: NDArray[np.float64], fx: float) -> float:
    """Return the share of splats that are spikes (`SPIKE_RATIO`, `SPIKE_PX`)."""
    axes, means = np.sort(field.scales.numpy(), axis=1), field.means.numpy()
    long = np.flatnonzero(axes[:, 2] > SPIKE_RATIO * axes[:, 1])
    nearest_m = np.full(len(long), np.inf)
    for T in T_world_camera:
        z = (means[long] @ se3.inverse(T)[2, :3]) + se3.inverse(T)[2, 3]
        nearest_m = np.where(z > 0.1, np.minimum(nearest_m, z), nearest_m)
    return float((2.0 * axes[long, 2] * fx / nearest_m > SPIKE_PX).sum() / max(len(field), 1))


def measure(options: Options) -> dict[str, Any]:
    """Make or read all runs."""
    return {"runs": [measured_run(job, options) for job in jobs_of(options)]}


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return a table per sequence: mean and standard deviation over the seeds of each figure, now and before."""
    runs = [run for run in measured["figures"]["runs"] if "problem" not in run]
    made = []
    for sequence in dict.fromkeys(run["sequence"] for run in runs):
        of_sequence = [run for run in runs if run["sequence"] == sequence]
        codes = list(dict.fromkeys(run["code"] for run in of_sequence))
        rows = [
            [heading, *(_cell([run.get(name) for run in of_sequence if run["code"] == code], factor) for code in codes)]
            for name, (heading, factor) in FIGURES.items()
        ]
        made.append(Section(f"{sequence}: held-out views, size and time", ["", *codes], rows))
    return made


def _cell(values: Sequence[float | None], factor: float) -> str:
    """Write mean ± standard deviation of the known values."""
    known = factor * np.array([value for value in values if value is not None])
    if not len(known):
        return significant(None)
    spread = f" ± {significant(float(known.std(ddof=1)), 2)}" if len(known) > 1 else ""
    return f"{significant(float(known.mean()), 4)}{spread}"


def main(options: Options) -> int:
    """Measure and write; return the exit code."""
    return program.run("map_quality", options, measure, options.seeds)


if __name__ == "__main__":
    program.start(main, Options)
