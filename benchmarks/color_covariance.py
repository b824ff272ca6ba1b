"""Compare one variance per colour channel (paper) with the full 3×3 colour covariance, on the same frames.

Both maps are built frame by frame, each with its own poses. Then the likelihood of the colours of held-out frames is
computed with both: on the same pixels, with the diagonal of V and with all of V.
Writes benchmarks/results/color-covariance-<machine>.json and prints a table.

example: python benchmarks/color_covariance.py --sources redkitchen --frames 30 --seeds 0
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import torch
import tyro
from accuracy_tables import spread
from cpu import alone
from numpy.typing import NDArray
from tables import Section
from torch import Tensor

from sigmasplat.config import Config, SubmapConfig
from sigmasplat.config.presets import default_preset, preset as preset_of
from sigmasplat.data import se3
from sigmasplat.data.color_covariance import correlations_of
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.errors import SourceError
from sigmasplat.fit import losses
from sigmasplat.plugins.evaluation.metrics import views
from sigmasplat.plugins.evaluation.metrics.scored_view import COVERED_ALPHA, ScoredView
from sigmasplat.plugins.sources import open_source
from sigmasplat.render import Render, render
from sigmasplat.slam.slam import Slam

arg = tyro.conf.arg
EXCLUDED = {"weight_moment": 0.0, "weight_alignment": 0.0}
"""Terms that full covariances exclude; both maps are made without them, and with the depth of centres."""
KINDS = ("diagonal", "full")
CHANNELS = 3


@dataclass(frozen=True)
class Options:
    """Compare one variance per colour channel with the full colour covariance."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = (
        "redkitchen",
        f"{accuracy.SYNTHETIC},noise=1",
    )
    frames: Annotated[int, arg(help="number of frames, from the start of each sequence")] = 60
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, a pair of maps for each")] = (0, 1, 2)
    name: Annotated[str, arg(help="name of the results")] = "color-covariance"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    def config(self, seed: int, kind: str) -> Config:
        """Return a run's settings, with a single submap. Raises ConfigError for an unknown preset."""
        config = replace(preset_of(self.preset), seed=seed, submaps=SubmapConfig())
        return config.changed(mapping={"color_covariance": kind} | EXCLUDED, render={"depth": "center"}).checked()


def measure(path: str, options: Options, seed: int) -> dict[str, Any]:
    """Build both maps and score them on held-out frames. Raises SourceError if there are none."""
    source = open_source(path, limit=options.frames)
    runs = {kind: Slam(options.config(seed, kind)) for kind in KINDS}
    for index, frame in enumerate(source):
        for kind in (
            KINDS if index % 2 else reversed(KINDS)
        ):  # alternate, so that neither always profits from a warm cache
            runs[kind].step(frame)
    steps = list(zip(*(run.steps for run in runs.values()), strict=True))
    held_out = [i for i, pair in enumerate(steps) if not any(step.is_keyframe or step.lost for step in pair)]
    if not held_out:
        raise SourceError(
            f"{path}: every frame was mapped, so no frame is held out; use a preset with mapping.every above 1"
        )
    i = options.config(seed, "full").input
    shown = [source.frame(steps[k][0].index) for k in held_out]
    frames = [frame.prepared(i.width, i.min_depth_m, i.max_depth_m, i.crop_px) for frame in shown]
    return {"seed": seed, "held_out": len(held_out), **score(runs, held_out, frames)}


def score(runs: dict[str, Slam], rows: Sequence[int], frames: Sequence[Frame]) -> dict[str, Any]:
    """Score both maps on frames (`rows` of their trajectories), on pixels with a reading that both maps cover."""
    fields = {kind: with_correlations(run.field) for kind, run in runs.items()}
    poses = {kind: se3.inverse(run.trajectory().T_world_camera) for kind, run in runs.items()}
    sums: dict[str, list[Any]] = {kind: [] for kind in KINDS}
    seen: dict[str, list[ScoredView]] = {kind: [] for kind in KINDS}
    for row, frame in zip(rows, frames, strict=True):
        renders = {kind: render(fields[kind], frame.camera, poses[kind][row]) for kind in KINDS}
        pixels = torch.from_numpy(frame.depth_m > 0)
        for r in renders.values():
            pixels &= r.alpha > COVERED_ALPHA
        for kind, r in renders.items():
            sums[kind].append(likelihoods(r, frame, pixels))
            seen[kind].append(view_of(r, frame, pixels))
    found = {kind: figures(runs[kind], fields[kind], np.array(sums[kind]), seen[kind]) for kind in KINDS}
    ratio = found["full"]["mapping_s"] / found["diagonal"]["mapping_s"]
    return {**found, "mapping_time_ratio": round(ratio, 3)}


def with_correlations(field: GaussianField) -> GaussianField:
    """Return the field with correlations, zeros if it has none, so that V is rendered completely."""
    field.get_or_create("correlations")
    return field


def likelihoods(r: Render, frame: Frame, pixels: Tensor) -> NDArray[np.float64]:
    """Return sums over pixels [9]: their number, the NLL of their colours with the diagonal and with all of V, Σ r rᵀ.

    Float64, ε = 1e-6 as in training, the constant 3/2 log 2π left out.
    """
    color, target, count = r.color.double(), torch.tensor(frame.color).double(), float(pixels.sum())
    assert r.covariance is not None
    V, scale = r.covariance.double(), CHANNELS * count
    diagonal = losses.nll_color(color, target, V[..., :CHANNELS], pixels)
    full = losses.nll_color_full(color, target, V, pixels)
    residual = (color - target)[pixels]
    second = (residual.T @ residual)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return np.array([count, scale * float(diagonal), scale * float(full), *second.tolist()])


def view_of(r: Render, frame: Frame, pixels: Tensor) -> ScoredView:
    """Return a render as evaluation scores it; other pixels count as without a reading."""
    depth = torch.where(pixels, r.depth / r.alpha.clamp(min=COVERED_ALPHA), 0.0)
    return ScoredView(
        frame.index, "held-out", frame.color, np.where(pixels.numpy(), frame.depth_m, np.float32(0.0)),
        r.color.clamp(0.0, 1.0).numpy(), depth.numpy(), r.alpha.numpy(), r.variance.numpy(),
    )  # fmt: skip


def figures(run: Slam, field: GaussianField, sums: NDArray[np.float64], seen: list[ScoredView]) -> dict[str, Any]:
    """Summarise one map: time, likelihood per pixel, correlations of splats and of errors, PSNR, Spearman."""
    count, diagonal, full, *second = sums.sum(0)
    deviations = np.sqrt(second[:CHANNELS])
    errors = second[CHANNELS:] / np.array([deviations[a] * deviations[b] for a, b in ((0, 1), (0, 2), (1, 2))])
    correlations = correlations_of(field.attributes["correlations"].params).abs().mean(0)
    scores = views.mean_scores([view.scores() for view in seen])
    judged = views.score_uncertainty([views.sample_pixels(view) for view in seen]) or {}
    return {
        "mapping_s": round(sum(step.seconds.get("map", 0.0) for step in run.steps), 3),
        "keyframes": sum(step.is_keyframe for step in run.steps),
        "splats": len(field),
        "pixels": int(count),
        "nll_diagonal": diagonal / count,
        "nll_full": full / count,
        "mean_correlation": correlations.tolist(),
        "error_correlation": errors.tolist(),
        "psnr_db": scores["psnr_db"],
        "spearman": judged.get("spearman"),
    }


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the figures: one row for each sequence and map, mean ± standard deviation over the seeds."""
    rows = []
    for source in measured["figures"]["sources"]:
        for kind in KINDS:
            found = [run[kind] for run in source["runs"]]
            ratios = [run["mapping_time_ratio"] for run in source["runs"]] if kind == "full" else [1.0]
            together = [float(np.mean(run["mean_correlation"])) for run in found]
            names = ("nll_diagonal", "nll_full", "psnr_db", "spearman")
            columns = [ratios, *([run[name] for run in found] for name in names[:2]), together]
            columns += [[run[name] for run in found] for name in names[2:]]
            rows.append([source["source"], kind, *(spread(values) for values in columns)])
    head = (
        "sequence",
        "covariance of colour",
        "mapping time / diagonal",
        "NLL, diagonal",
        "NLL, full",
        "mean absolute ρ",
        "PSNR, dB",
        "Spearman",
    )
    note = "NLL in nats per pixel, 3 channels, on held-out frames, with the diagonal of V and with all of V."
    return [Section("Colour covariance", head, rows, note)]


def measure_all(options: Options) -> dict[str, Any]:
    """Measure every sequence with every seed, each pair of maps in a fresh process."""
    found = []
    for source in options.sources:
        runs = []
        for seed in options.seeds:
            runs.append(alone(measure, accuracy.located(source), options, seed))
            line = f"{Path(source).name}, seed {seed}: {runs[-1]['mapping_time_ratio']} times the mapping time"
            print(line, file=sys.stderr, flush=True)
        found.append({"source": Path(source).name, "runs": runs})
    return {"sources": found}


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("color_covariance", options, measure_all, options.seeds)


if __name__ == "__main__":
    program.start(main, Options)
