"""Measure things that move: a ball in the synthetic room, which covers a given share of the image on average.

For each share and seed one run on the room with the ball, with `moving.find` on and off, beside the still room (share
0). Scored: path; mask of each frame against the true one, while the ball moves; what is left of the ball in the final
map; held-out views of the still room. Recordings (--still) show how the search changes path and map where nothing
moves; search_cost.py measures the time.
Writes benchmarks/results/moving-<machine>.json and prints tables.

example: python benchmarks/moving.py --shares 0 20 --seeds 0
"""

import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tyro
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tables import Section, significant

from sigmasplat.commands.options import Settings
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override, split_settings
from sigmasplat.data import se3
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.image import psnr
from sigmasplat.plugins.evaluation.metrics.trajectory import ate
from sigmasplat.plugins.sources import open_source
from sigmasplat.plugins.sources.synthetic import SyntheticRoom
from sigmasplat.render import render
from sigmasplat.system.slam import Slam
from sigmasplat.tracking.prepared_frame import working_frame

arg = tyro.conf.arg
Mask = NDArray[np.bool_]
HOLD_EVERY = 8
NEAR_M = 0.05
"""Splats up to this far from the surface of the ball, at any place of its path, count as left of it."""
LARGEST = 30
"""Share of the image, percent, of the ball near whose path the map of the still room is looked at."""
OWN_M = 0.06
"""Splats up to this far from a vertex of the still room's surface belong to it; vertices are at most 5 cm apart."""
CLEAR_M, CLEAR_RELATIVE = 0.05, 0.05
"""A rendered pixel is in front of the still room if its depth is smaller by this distance and this share."""


@dataclass(frozen=True)
class Options:
    """Run the synthetic room with a moving ball; measure path, masks, and what is left of the ball in the map."""

    shares: Annotated[tuple[int, ...], arg(help="percent of the image that the ball covers; 0 is the still room")] = (
        0, 10, 20, 30,
    )  # fmt: skip
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, two runs for each")] = (0, 1, 2)
    frames: Annotated[int, arg(help="frames of the room")] = 200
    width: Annotated[int, arg(help="width of the images of the room, pixels")] = 160
    still: Annotated[tuple[str, ...], arg(help="recordings without motion: names in the data folder, or paths")] = ()
    limit: Annotated[int | None, arg(help="number of frames of the recordings at most")] = None
    find: Annotated[tuple[int, ...], arg(help="values of moving.find")] = (0, 1)
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ()
    name: Annotated[str, arg(help="name of the results")] = "moving"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def config_of(base: str, settings: Settings, find: bool) -> Config:
    """Return the settings of a run with the search or without, from the name of a preset."""
    return override(preset(base), {"moving.find": str(find).lower()} | split_settings(settings))


def scored_config(base: str, settings: Settings, seed: int, find: bool) -> Config:
    """Return the same for a run whose held-out views are scored."""
    return config_of(base, (f"seed={seed}", f"input.hold_every={HOLD_EVERY}", *settings), find)


@dataclass(eq=False)
class Followed:
    """A finished run: the system, the masks of what moved [H, W] of each frame, and processor seconds of the frames."""

    slam: Slam
    masks: list[Mask]
    frames_s: float


def followed(source: Source, config: Config) -> Followed:
    """Run SLAM on a source, and keep what each frame took for moving."""
    slam, masks, spent_s = Slam(config), list[Mask](), 0.0
    for frame in source:
        since_s = time.process_time()
        slam.step(frame)
        spent_s += time.process_time() - since_s
        front = slam.tracker.front
        masks.append(np.zeros(frame.depth_m.shape, np.bool_) if front is None else front.hidden.copy())
    slam.finish()
    return Followed(slam, masks, spent_s)


def measure_room(share: int, seed: int, find: int, options: Options) -> dict[str, Any]:
    """Make one run in the room; return its figures."""
    config = scored_config(options.preset, options.settings, seed, bool(find)).changed(input={"width": options.width})
    text = f"synthetic:frames={options.frames},noise=1,exposure_change=0,seed={seed}"
    text += f",width={options.width},height={options.width * 3 // 4}"
    source, still, path_of = (open_source(f"{text},mover={n}") for n in (share, 0, share or LARGEST))
    assert isinstance(source, SyntheticRoom) and isinstance(still, SyntheticRoom)
    assert isinstance(path_of, SyntheticRoom)
    run = followed(source, config)
    slam, truth = run.slam, source.truth()
    path = slam.trajectory()
    found = ate(path, truth)
    views = [shown(run, still, i, path.T_world_camera[i]) for i in range(HOLD_EVERY - 1, len(source), HOLD_EVERY)]
    return {
        "share": share, "seed": seed, "find": find, "lost": sum(step.lost for step in slam.steps),
        "ate_cm": 100 * found.rmse_m, "psnr_db": float(np.mean([v["psnr_db"] for v in views])),
        "in_front_pct": 100 * float(np.mean([v["in_front"] for v in views])),
        "left": left_of(run, path_of, still), "frames_s": run.frames_s, "splats": len(slam.field),
    } | masks_of(run, source)  # fmt: skip


def masks_of(run: Followed, source: SyntheticRoom) -> dict[str, float | None]:
    """Score the masks of a run in the room."""
    ball = source.mover
    moves = (ball is not None and ball.moves(i) for i in range(len(run.masks)))
    return scored_masks(zip(run.masks, map(source.moving_of, range(len(run.masks))), moves, strict=True))


def scored_masks(frames: Iterable[tuple[Mask, Mask, bool]]) -> dict[str, float | None]:
    """Score masks by the true ones [H, W], which count only while something moves: return the intersection over union,
    summed over the frames, and the share of the image that is masked where nothing moves."""
    both = either = wrong = rest = 0
    for mask, true, moves in frames:
        wrong, rest = wrong + int((mask & ~true).sum()), rest + int((~true).sum())
        if moves:
            both, either = both + int((mask & true).sum()), either + int((mask | true).sum())
    return {"iou": both / either if either else None, "masked_wrongly_pct": 100 * wrong / max(rest, 1)}


def shown(run: Followed, still: SyntheticRoom, i: int, T_world_camera: NDArray[np.float64]) -> dict[str, float]:
    """Render the final map at a frame's estimated pose; return PSNR to the still room, and the share of the pixels at
    which the map is clearly nearer than it."""
    rendered = render(run.slam.field, still.camera, se3.inverse(T_world_camera))
    alpha, depth = rendered.alpha.numpy(), rendered.depth.numpy()
    exact_m = still.exact_depth_of(i)
    nearer = (alpha > 0.5) & (depth / np.maximum(alpha, 0.5) < exact_m * (1 - CLEAR_RELATIVE) - CLEAR_M)
    color = np.clip(rendered.color.numpy(), 0.0, 1.0)
    return {"psnr_db": float(psnr(color, still.frame(i).color)), "in_front": float(nearer.mean())}


def left_of(run: Followed, source: SyntheticRoom, still: SyntheticRoom) -> float:
    """Return the sum of the opacities of the splats of the final map near the ball of a source at any place of its
    path."""
    assert source.mover is not None
    T_estimate_truth = run.slam.trajectory().T_world_camera[0] @ se3.inverse(source.truth().T_world_camera[0])
    centers = source.mover.centers_m @ T_estimate_truth[:3, :3].T + T_estimate_truth[:3, 3]
    means = run.slam.field.means.numpy().astype(np.float64)
    apart = np.min([np.linalg.norm(means - center, axis=1) for center in centers[::2]], axis=0)
    near = np.flatnonzero(apart < source.mover.radius_m + NEAR_M)
    surface = still.true_surface().vertices @ T_estimate_truth[:3, :3].T + T_estimate_truth[:3, 3]
    floating = near[np.asarray(cKDTree(surface).query(means[near])[0]) > OWN_M]
    return float(run.slam.field.opacities.numpy()[floating].sum())


def measure_still(source: str, seed: int, find: int, options: Options) -> dict[str, Any]:
    """Make one run on a recording in which nothing moves; return its figures."""
    config = scored_config(options.preset, options.settings, seed, bool(find))
    if options.limit is not None:
        config = config.changed(input={"limit": options.limit})
    recording = open_source(accuracy.located(source), config.input)
    run = followed(recording, config)
    path, truth, scores = run.slam.trajectory(), recording.truth(), []
    for i in range(HOLD_EVERY - 1, len(recording), HOLD_EVERY):
        frame = working_frame(recording.frame(i), config)
        rendered = render(run.slam.field, frame.camera, se3.inverse(path.T_world_camera[i]), options=config.render)
        scores.append(psnr(np.clip(rendered.color.numpy(), 0.0, 1.0), frame.color))
    return {
        "source": source, "seed": seed, "find": find, "psnr_db": float(np.mean(scores)),
        "ate_cm": None if truth is None else 100 * ate(path, truth).rmse_m,
        "masked_pct": 100 * float(np.mean([mask.mean() for mask in run.masks])),
        "splats": len(run.slam.field), "lost": sum(step.lost for step in run.slam.steps),
    }  # fmt: skip


def measure(options: Options) -> dict[str, Any]:
    """Measure every share, seed and recording with and without the search."""
    runs, still = [], []
    for seed in options.seeds:
        for find in options.find:
            for share in options.shares:
                runs.append(measure_room(share, seed, find, options))
                print(runs[-1], file=sys.stderr, flush=True)
            for source in options.still:
                still.append(measure_still(source, seed, find, options))
                print(still[-1], file=sys.stderr, flush=True)
    return {"runs": runs, "still": still}


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the runs in the room, and those on recordings."""
    rooms = [
        [str(r["share"]), str(r["seed"]), "on" if r["find"] else "off", *(figure_text(r[name]) for name in ROOM)]
        for r in measured["figures"]["runs"]
    ]
    still = [
        [r["source"], str(r["seed"]), "on" if r["find"] else "off", *(figure_text(r[name]) for name in STILL)]
        for r in measured["figures"]["still"]
    ]
    note = (
        "IoU: of the masks of all frames in which the ball moves. Too near: pixels of held-out views at which the "
        "final map is at least 5 cm + 5 % nearer than the still room. Left: summed opacity of splats up to 5 cm from "
        "the ball, at any place of its path, and more than 6 cm from the room's own surface (share 0: of the ball of "
        "30 %). Time: processor seconds of all frames, without the final map."
    )
    head = ("share, %", "seed", "search", "ATE, cm", "lost frames", "IoU", "wrongly masked, %", "too near, %", "left")
    found = [Section("Moving ball", (*head, "PSNR, dB", "time, s"), rooms, note)] if rooms else []
    columns = ("recording", "seed", "search", "ATE, cm", "lost frames", "masked, %", "PSNR, dB", "splats")
    return found + ([Section("Nothing moves", columns, still)] if still else [])


ROOM = ("ate_cm", "lost", "iou", "masked_wrongly_pct", "in_front_pct", "left", "psnr_db", "frames_s")
STILL = ("ate_cm", "lost", "masked_pct", "psnr_db", "splats")


def figure_text(value: float | None) -> str:
    return "–" if value is None else str(value) if isinstance(value, int) else significant(value)


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("moving", options, measure, options.seeds)


if __name__ == "__main__":
    program.start(main, Options)
