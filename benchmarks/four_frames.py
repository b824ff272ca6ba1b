"""Fit four frames at true poses and score the depth of the next views: a short test of geometry.

Four frames become keyframes of one map at their true poses; the map is scored after its mapping steps ("mapped"), and
after further steps on the four frames ("fitted"). The next frames are rendered at their true poses. Only pixels whose
surface one of the four frames has seen are scored, so that all maps are scored on the same pixels.
Writes benchmarks/results/four-frames-<machine>.json and prints a table. With PYTHONPATH=CHECKOUT/src the code of
another checkout is measured.

example: python benchmarks/four_frames.py --sources livingroom --starts 0 --steps 300
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import program
import record
import torch
import tyro
from accuracy_tables import spread
from numpy.typing import NDArray
from tables import Section

import sigmasplat
from sigmasplat.commands.options import Settings
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset as preset_of
from sigmasplat.config.text import override, split_settings
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.errors import SourceError
from sigmasplat.files.machine import code_digest
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.input.source import Source
from sigmasplat.mapping.mapper import Mapper
from sigmasplat.plugins.evaluation.metrics.image import psnr
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.plugins.sources import open_source
from sigmasplat.render import render
from sigmasplat.types import completed, never

try:
    from sigmasplat.render.backend import make_view
except ImportError:  # an older checkout
    from sigmasplat.render.view import make_view  # type: ignore[attr-defined, no-redef]

arg = tyro.conf.arg
Matrix = NDArray[np.float64]
Mask = NDArray[np.bool_]
FITTED = 4
SAME_SURFACE = 0.02
"""A pixel shows a surface that a frame has seen if the depths differ by at most this share."""
COVERED = 0.5
FRAMES_KEPT = 40
STAGES = ("mapped", "fitted")


@dataclass(frozen=True)
class Options:
    """Fit four frames at true poses and score the depth of the next views."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = (
        "livingroom", "synthetic:frames=200", "redkitchen",
    )  # fmt: skip
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ()
    width: Annotated[int, arg(help="working width, pixels")] = 320
    starts: Annotated[tuple[int, ...], arg(help="first frame of each fit")] = (0, 60, 120)
    spacing: Annotated[int, arg(help="frames from one fitted frame to the next")] = 5
    views: Annotated[int, arg(help="number of views that are scored, the frames after the last fitted one")] = 60
    every: Annotated[int, arg(help="score every n-th of these views")] = 3
    steps: Annotated[int, arg(help="optimisation steps on the four frames after mapping")] = 600
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one fit for each")] = (0,)
    name: Annotated[str, arg(help="name of the results")] = "four-frames"
    quick: Annotated[bool, arg(help="a minute: one sequence, one start, no results written")] = False
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    def config(self, seed: int) -> Config:
        """Return the settings of a fit: one map, poses fixed. Raises ConfigError for an unknown preset or setting."""
        config = override(preset_of(self.preset), split_settings(self.settings))
        fixed = replace(config.mapping, lr_pose_translation=0.0, lr_pose_rotation=0.0)
        return replace(config, seed=seed, mapping=fixed, input=replace(config.input, width=self.width))


class TrueSequence:
    """Frames at working size and their true poses T_world_camera; SourceError if a frame has no true pose."""

    def __init__(self, source: Source, config: Config) -> None:
        self.source, self.input = source, config.input
        self.frame, self.pose = lru_cache(FRAMES_KEPT)(self._frame), lru_cache(None)(self._pose)

    def __len__(self) -> int:
        return len(self.source)

    def _frame(self, i: int) -> Frame:
        s = self.input
        return self.source.frame(i).prepared(s.width, s.min_depth_m, s.max_depth_m, s.crop_px)

    def _pose(self, i: int) -> Matrix:
        truth = self.source.truth()
        rows = associate(np.array([self.frame(i).timestamp_s]), truth.timestamps_s)[1] if truth else []
        if truth is None or not len(rows):
            raise SourceError(f"{self.source.name}: frame {i} has no true pose; choose other --starts")
        return truth.T_world_camera[rows[0]]

    def seen(self, i: int, fitted: Sequence[int]) -> Mask:
        """Return which pixels of a frame show a surface that one of the fitted frames has seen, bool [H, W]."""
        frame = self.frame(i)
        points = frame.camera.rays() * frame.depth_m[..., None].astype(np.float64)
        found = np.zeros(frame.depth_m.shape, bool)
        for k in fitted:
            other, T = self.frame(k), se3.inverse(self.pose(k)) @ self.pose(i)
            x, y, z = np.moveaxis(points @ T[:3, :3].T + T[:3, 3], -1, 0)
            ahead, camera = np.maximum(z, 1e-6), other.camera
            u = np.rint(camera.fx * x / ahead + camera.cx).astype(int)
            v = np.rint(camera.fy * y / ahead + camera.cy).astype(int)
            inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
            there = other.depth_m[v.clip(0, camera.height - 1), u.clip(0, camera.width - 1)]
            found |= inside & (np.abs(there - z) < SAME_SURFACE * z)
        return np.asarray(found & (frame.depth_m > 0))


def fit(sequence: TrueSequence, config: Config, fitted: Sequence[int], steps: int) -> dict[str, GaussianField]:
    """Map the fitted frames at their true poses; return the map after each stage."""
    random = np.random.default_rng(config.seed)
    view = make_view(config.backend, sequence.frame(fitted[0]).camera, config.render)
    mapper = Mapper(config, random)
    T_map_world = se3.inverse(sequence.pose(fitted[0]))
    for i in fitted:
        target = Target.of(denoised(sequence.frame(i), config), (view.alpha.shape[0], view.alpha.shape[1]))
        completed(mapper.mapping(view, Keyframe(i, target, T_map_world @ sequence.pose(i))))
        completed(mapper._left_of_half(view, never))
    made = {"mapped": GaussianField(mapper.field.params.clone())}
    drawn = ([mapper.keyframes[int(random.integers(len(fitted)))]] for _ in range(steps))
    fit_field(mapper.field, view, drawn, config.mapping)
    return made | {"fitted": mapper.field}


def denoised(frame: Frame, config: Config) -> Frame:
    """Return a frame with the depth that mapping would get; a checkout may be older than `input.denoise_depth`."""
    if not getattr(config.input, "denoise_depth", False):
        return frame
    from sigmasplat.tracking.depth_filters import denoised

    return replace(frame, depth_m=denoised(frame.depth_m))


def located(name: str) -> str:
    """Return the path of a sequence in the data folder, or the name unchanged if it is not there."""
    known = record.data_root() / name
    return str(known.resolve()) if known.is_dir() else name


def score(sequence: TrueSequence, field: GaussianField, config: Config, T_map_world: Matrix, i: int, seen: Mask) -> Any:
    """Return depth L1 (m, Σwz / Σw where alpha is above ½), PSNR (dB) and covered share of the seen pixels."""
    frame = sequence.frame(i)
    with torch.no_grad():
        r = render(field, frame.camera, se3.inverse(T_map_world @ sequence.pose(i)), None, config.render)
    alpha = r.alpha.numpy()
    covered = seen & (alpha > COVERED)
    depth_m = r.depth.numpy() / np.maximum(alpha, COVERED)
    error_m = np.abs(depth_m - frame.depth_m)[covered]
    return {
        "depth_l1_m": float(error_m.mean()),
        "depth_median_m": float(np.median(error_m)),
        "psnr_db": psnr(r.color.numpy().clip(0.0, 1.0), frame.color, seen),
        "covered": float(covered.sum() / seen.sum()),
    }


def measure_fit(sequence: TrueSequence, options: Options, start: int, seed: int) -> dict[str, Any]:
    """Fit four frames from `start` on; return the mean scores of the next views, by seen pixels, after each stage."""
    config = options.config(seed)
    fitted = [start + k * options.spacing for k in range(FITTED)]
    later = [i for i in range(fitted[-1] + 1, len(sequence))][: options.views : options.every]
    T_map_world = se3.inverse(sequence.pose(start))
    pixels = {i: sequence.seen(i, fitted) for i in later}
    views = [i for i in later if pixels[i].mean() > 0.05]
    result: dict[str, Any] = {"start": start, "seed": seed, "views": len(views)}
    for stage, field in fit(sequence, config, fitted, options.steps).items():
        rows = [score(sequence, field, config, T_map_world, i, pixels[i]) for i in views]
        weights = [pixels[i].sum() for i in views]
        result[stage] = {name: float(np.average([row[name] for row in rows], weights=weights)) for name in rows[0]}
        result[stage]["splats"] = len(field)
    return result


def measure(options: Options) -> dict[str, Any]:
    """Measure every sequence, start and seed. Raises SourceError if a sequence is too short or has no true poses."""
    found = []
    for source in options.sources:
        sequence = TrueSequence(open_source(located(source), options.config(0).input), options.config(0))
        if max(options.starts) + FITTED * options.spacing >= len(sequence):
            raise SourceError(f"{source} has {len(sequence)} frames; choose earlier --starts")
        fits = []
        for start in options.starts:
            for seed in options.seeds:
                fits.append(measure_fit(sequence, options, start, seed))
                parts = [
                    f"{s} {1e3 * fits[-1][s]['depth_l1_m']:.2f} mm {fits[-1][s]['psnr_db']:.2f} dB" for s in STAGES
                ]
                print(f"{Path(source).name} from {start}, seed {seed}: {', '.join(parts)}", file=sys.stderr, flush=True)
        found.append({"source": Path(source).name, "fits": fits})
    return {"measured_code": code_digest(Path(sigmasplat.__file__).parent), "sources": found}


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the figures: one row for each sequence and stage, mean ± standard deviation over starts and seeds."""
    rows = []
    for source in measured["figures"]["sources"]:
        for stage in STAGES:
            of = [one[stage] for one in source["fits"]]
            columns = [[1e3 * f["depth_l1_m"] for f in of], [1e3 * f["depth_median_m"] for f in of]]
            columns += [[f["psnr_db"] for f in of], [100.0 * f["covered"] for f in of]]
            rows.append([source["source"], stage, *(spread(values) for values in columns)])
    head = ("sequence", "map", "depth L1, mm", "median error, mm", "PSNR, dB", "covered, %")
    steps = measured["config"]["steps"]
    note = f"Next views at true poses, pixels that the four frames have seen. Fitted: {steps} more steps."
    return [Section("Four frames", head, rows, note)]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    if options.quick:
        options = replace(options, sources=options.sources[:1], starts=options.starts[:1], steps=100)
    return program.run("four_frames", options, measure, options.seeds, not options.quick)


if __name__ == "__main__":
    program.start(main, Options)
