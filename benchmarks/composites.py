"""Measure things that move in real recordings: a ball is drawn into colour and depth, and moves ahead of the camera.

The recording itself stays the truth of everything but the ball: true masks, the path, and views without the ball are
known. The ball moves as in the synthetic room (`Mover`: slowly, fast, not at all, and on) around a place in front
of the camera's path; nearer surfaces hide it. Its depth has the noise of a structured-light sensor. For each share of
the image, runs with `moving.find` on and off, beside the recording without the ball (share 0).
Writes benchmarks/results/composites-<machine>.json and prints tables.

example: python benchmarks/composites.py --sources redkitchen --shares 0 10 --limit 200
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from moving import (
    CLEAR_M,
    CLEAR_RELATIVE,
    HOLD_EVERY,
    Followed,
    Mask,
    figure_text,
    followed,
    scored_config,
    scored_masks,
)
from numpy.typing import NDArray
from PIL import Image
from tables import Section

from sigmasplat.commands.options import Settings
from sigmasplat.config import Config, InputConfig
from sigmasplat.config.find_preset import default_preset
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.input.source import Source, Subset
from sigmasplat.plugins.evaluation.metrics.image import psnr
from sigmasplat.plugins.evaluation.metrics.trajectory import associate, ate
from sigmasplat.plugins.sources import open_source
from sigmasplat.plugins.sources.room.capture import measured_color, measured_depth
from sigmasplat.plugins.sources.room.furnish import CENTER_M, mover
from sigmasplat.render import render
from sigmasplat.tracking.prepared_frame import working_frame

arg = tyro.conf.arg
AWAY = 0.6
"""Distance of the place from the camera, in median depths of the recording, on average."""
CELLS = 9
"""Number of coloured cells from pole to pole."""
LIGHT = np.array([0.3, -0.8, -0.5])
"""Direction to the light, in the camera's axes."""
COLUMNS = ("ate_cm", "ratio", "lost", "iou", "masked_wrongly_pct", "in_front_pct", "psnr_db")


@dataclass(frozen=True)
class Options:
    """Draw a moving ball into recordings; measure path, masks, and what is left of the ball in the map."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = (
        "redkitchen", "livingroom", "hololens", "cubicles",
    )  # fmt: skip
    shares: Annotated[tuple[int, ...], arg(help="percent of the image that the ball covers; 0 is without it")] = (
        0, 10,
    )  # fmt: skip
    find: Annotated[tuple[int, ...], arg(help="values of moving.find")] = (0, 1)
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run for each")] = (0,)
    limit: Annotated[int, arg(help="number of frames at most; 0 = all")] = 200
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ()
    name: Annotated[str, arg(help="name of the results")] = "composites"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


class WithBall(Subset):
    """A recording with a ball that covers this share of the image on average, 0 to 1, where nothing hides it."""

    def __init__(self, whole: Source, share: float) -> None:
        super().__init__(whole, InputConfig())
        camera, truth = whole.camera, whole.truth()
        assert truth is not None, "the ball follows the true path"
        rows = associate(np.array([whole.timestamp_s(i) for i in range(len(whole))]), truth.timestamps_s)[1]
        self._T_world_camera = truth.T_world_camera[rows].copy()
        depths = np.concatenate([z[z > 0] for z in map(whole.depth_of, range(0, len(whole), max(1, len(whole) // 20)))])
        away_m = AWAY * float(np.median(depths))
        ahead = self._T_world_camera[:, :3, 3] + away_m * self._T_world_camera[:, :3, 2]
        self._T_world_camera[:, :3, 3] += CENTER_M - ahead.mean(0)  # the ball moves around this point
        ball = mover(self._T_world_camera, camera, share)
        self.radius_m, self.centers_m = ball.radius_m if share else 0.0, ball.centers_m

    def frame(self, i: int) -> Frame:
        """Read frame i and draw the ball into it."""
        frame = super().frame(i)
        color, ball_m = self._ball(i)
        shown, rng = _in_front(ball_m, frame.depth_m), np.random.default_rng((i, 5))
        measured_m = measured_depth(np.where(shown, ball_m, np.float32(0.0)), self.camera, rng)
        return replace(
            frame,
            color=np.where(shown[..., None], measured_color(color, rng), frame.color),
            depth_m=np.where(shown, measured_m, frame.depth_m),
        )

    def moving_of(self, i: int) -> Mask:
        """Return the pixels [H, W] of frame i that show the ball."""
        return _in_front(self._ball(i)[1], super().frame(i).depth_m)

    def _ball(self, i: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Render the ball alone: colour [H, W, 3], depth [H, W] m, 0 beside it."""
        T, rays = self._T_world_camera[i], np.asarray(self.camera.rays(), np.float64)
        center = T[:3, :3].T @ (self.centers_m[i] - T[:3, 3])
        # |z · ray − center|² = radius², the nearer solution
        a, b, c = (rays**2).sum(-1), rays @ center, center @ center - self.radius_m**2
        inside = b * b - a * c
        z = np.where((inside > 0) & (b > 0) & (c > 0), (b - np.sqrt(np.maximum(inside, 0.0))) / a, 0.0)
        normal = (z[..., None] * rays - center) / max(self.radius_m, 1e-9)
        fixed = normal @ T[:3, :3].T
        cell = np.floor(CELLS * np.arccos(np.clip(fixed[..., 2], -1, 1)) / np.pi).astype(int)
        cell = 2 * CELLS * cell + np.floor(CELLS * (1 + np.arctan2(fixed[..., 1], fixed[..., 0]) / np.pi)).astype(int)
        paint = np.random.default_rng(3).uniform(0.15, 0.95, (2 * CELLS * (CELLS + 1) + 1, 3))[cell]
        light = 0.55 + 0.45 * np.clip(normal @ (LIGHT / np.linalg.norm(LIGHT)), 0.0, 1.0)
        return (paint * light[..., None]).astype(np.float32), z.astype(np.float32)


def _in_front(ball_m: NDArray[np.float32], depth_m: NDArray[np.float32]) -> Mask:
    return np.asarray((ball_m > 0) & ((depth_m == 0) | (ball_m < depth_m)))


def measure_run(name: str, share: int, seed: int, find: int, options: Options) -> dict[str, Any]:
    """Make one run; return its figures."""
    config = scored_config(options.preset, options.settings, seed, bool(find))
    recording = open_source(accuracy.located(name), limit=options.limit)
    source = WithBall(recording, share / 100)
    run = followed(source, config)
    path, truth = run.slam.trajectory(), recording.truth()
    assert truth is not None
    views = [shown(run, recording, i, config) for i in range(HOLD_EVERY - 1, len(recording), HOLD_EVERY)]
    return {
        "source": name, "share": share, "seed": seed, "find": find, "frames": len(recording),
        "lost": sum(step.lost for step in run.slam.steps), "ate_cm": 100 * ate(path, truth).rmse_m,
        "psnr_db": float(np.mean([view[0] for view in views])),
        "in_front_pct": 100 * float(np.mean([view[1] for view in views])),
        "frames_s": run.frames_s,
    } | masks_of(run, source)  # fmt: skip


def masks_of(run: Followed, source: WithBall) -> dict[str, float | None]:
    """Score the masks of a run."""
    return scored_masks((mask, _true_mask(source, i, mask), source.radius_m > 0) for i, mask in enumerate(run.masks))


def _true_mask(source: WithBall, i: int, mask: Mask) -> Mask:
    """Return the pixels of frame i that show the ball, at the size of another mask."""
    return np.asarray(Image.fromarray(source.moving_of(i)).resize(mask.shape[::-1], Image.Resampling.NEAREST))


def shown(run: Followed, recording: Source, i: int, config: Config) -> tuple[float, float]:
    """Render the final map at a frame's estimated pose; return PSNR to the frame without the ball, and the share of its
    readings at which the map is clearly nearer."""
    frame, T = working_frame(recording.frame(i), config), run.slam.trajectory().T_world_camera[i]
    rendered = render(run.slam.field, frame.camera, se3.inverse(T), options=config.render)
    alpha, depth = rendered.alpha.numpy(), rendered.depth.numpy()
    map_m, read = depth / np.maximum(alpha, 0.5), (alpha > 0.5) & (frame.depth_m > 0)
    nearer = read & (map_m < frame.depth_m * (1 - CLEAR_RELATIVE) - CLEAR_M)
    score = float(psnr(np.clip(rendered.color.numpy(), 0.0, 1.0), frame.color))
    return score, float(nearer.sum() / max(int(read.sum()), 1))


def measure(options: Options) -> dict[str, Any]:
    """Measure every recording and share with and without the search."""
    runs = []
    for name in options.sources:
        for seed in options.seeds:
            for find in options.find:
                for share in options.shares:
                    runs.append(measure_run(name, share, seed, find, options))
                    print(runs[-1], file=sys.stderr, flush=True)
    return {"runs": runs}


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the runs, with the path error relative to the recording without the ball."""
    runs, rows = measured["figures"]["runs"], []
    for r in runs:
        same = ("source", "seed", "find")
        still = [s["ate_cm"] for s in runs if s["share"] == 0 and all(s[name] == r[name] for name in same)]
        with_ratio = r | {"ratio": r["ate_cm"] / still[0] if still else None}
        figures = (figure_text(with_ratio[name]) for name in COLUMNS)
        rows.append([r["source"], str(r["share"]), str(r["seed"]), "on" if r["find"] else "off", *figures])
    note = (
        "Ratio: ATE relative to the recording without the ball. IoU: of the masks of all frames. Too near: readings of "
        "held-out frames without the ball at which the final map is at least 5 cm + 5 % nearer. PSNR: of these frames."
    )
    head = ("recording", "share, %", "seed", "search", "ATE, cm", "ratio", "lost frames", "IoU", "wrongly masked, %")
    return [Section("A ball in real recordings", (*head, "too near, %", "PSNR, dB"), rows, note)]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("composites", options, measure, options.seeds)


if __name__ == "__main__":
    program.start(main, Options)
