"""Run parts of recordings that nobody chose, beside the plain system: a seed draws them.

A variant is a part of a recording, with every n-th frame, forwards or backwards, of the whole image, its middle or a
quarter of its size, clean or disturbed. A rule that suits only the recordings it was made on loses here to plain.py;
with another seed there are other variants. Two processes of one thread; no final map. Linux only.

example: python benchmarks/variants.py --number 24 --seed 1
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import accuracy
import board_runs
import cv2
import numpy as np
import plain
import program
import record
import robustness_scores
import tables
import tyro
from board_tables import QUANTITIES, verdict_of
from disturbances import DISTURBANCES, Plan
from disturbed_recordings import FRAMES_PER_SECOND, Original, original, write
from tqdm import tqdm

from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SigmaSplatError

arg = tyro.conf.arg
SOURCES = ("fr1_xyz", "livingroom", "redkitchen", "hololens", "cubicles", "cabinet58")
FEWEST, MOST = 40, 150
"""Frames of a variant, if the recording has as many."""
STEPS, SIZES = (1, 1, 2, 3), ("whole", "whole", "middle", "quarter")
DISTURBED = (
    "clean", "clean", "depth-noise", "shared-noise", "coarse-depth", "edge-erosion", "missing", "range-clip",
    "blur", "color-noise",
)  # fmt: skip
SEVEREST, PROCESSES = 2, 2
FAILURES = (SigmaSplatError, ValueError, RuntimeError, OSError)
"""The plain system may diverge: its poses are not finite, or its graph is singular."""


@dataclass(frozen=True)
class Variant:
    """What is run. frames: of the recording, in the order in which they are shown."""

    source: str
    frames: tuple[int, ...]
    size: str
    disturbance: str
    severity: int

    @property
    def words(self) -> list[str]:
        """Return recording, frames, size of the images, and disturbance in words."""
        first, last = self.frames[0], self.frames[-1]
        step = abs(self.frames[1] - first)
        title = DISTURBANCES[self.disturbance]
        disturbed = f"{title.title} {title.labels[self.severity - 1]}" if self.disturbance != "clean" else "–"
        return [self.source, f"{first} … {last}{f' by {step}' if step > 1 else ''}", self.size, disturbed]


@dataclass(frozen=True)
class Options:
    """Run parts of recordings that nobody chose, beside the plain system."""

    sources: Annotated[tuple[str, ...], arg(help="recordings with truth: names in the data folder, or paths")] = SOURCES
    number: Annotated[int, arg(help="number of variants")] = 24
    seed: Annotated[int, arg(help="draws the variants")] = 0
    name: Annotated[str, arg(help="name of the results")] = "variants"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def drawn(source: str, available: int, random: np.random.Generator) -> Variant:
    """Draw a variant of a recording with so many frames that have a true pose."""
    count = min(available, int(random.integers(FEWEST, MOST + 1)))
    step = min(int(random.choice(STEPS)), max(available // count, 1))
    first = int(random.integers(0, available - (count - 1) * step))
    frames = list(range(first, first + count * step, step))
    if random.random() < 0.25:
        frames.reverse()
    name = str(random.choice(DISTURBED))
    severity = 1 if name == "clean" else int(random.integers(1, SEVEREST + 1))
    return Variant(source, tuple(frames), str(random.choice(SIZES)), name, severity)


def resized(from_: Original, frames: tuple[int, ...], size: str) -> Original:
    """Return some frames of a recording, in this order, with the middle or a quarter of its images."""
    rows, c = from_.frames[list(frames)], from_.camera
    color, depth = from_.color[rows], from_.depth[rows]
    if size == "middle":
        y, x = c.height // 4, c.width // 4
        color, depth = (images[:, y : y + c.height // 2, x : x + c.width // 2] for images in (color, depth))
        c = replace(c, width=c.width // 2, height=c.height // 2, cx=c.cx - x, cy=c.cy - y)
    if size == "quarter":
        c = c.resized(c.width // 4, c.height // 4)
        color = np.stack([cv2.resize(image, (c.width, c.height), interpolation=cv2.INTER_AREA) for image in color])
        depth = np.stack([cv2.resize(image, (c.width, c.height), interpolation=cv2.INTER_NEAREST) for image in depth])
    kept = np.arange(len(frames))
    return replace(
        from_, camera=c, color=color, depth=depth, frames=kept, T_world_camera=from_.T_world_camera[[*frames]]
    )


def perform(variant: Variant, images: Original, seed: int, scratch: Path) -> dict[str, Any]:
    """Run both systems on a variant; return their figures."""
    with TemporaryDirectory(dir=scratch) as folder:
        path, every = Path(folder) / "recording", np.arange(len(variant.frames))
        shown = resized(images, variant.frames, variant.size)
        write(shown, Plan(every, every), variant.disturbance, variant.severity, seed, path)
        found: dict[str, Any] = {"variant": variant.words, "problem": None, "frames": len(every)}
        truth = Trajectory(every / FRAMES_PER_SECOND, shown.T_world_camera)
        try:
            found["plain_ate_m"] = plain.run(str(path), 0, truth)["ate_m"]
        except FAILURES:
            found["plain_ate_m"] = None
        try:
            board_runs.run([str(path), "--seed", "0"], record.ROOT, Path(folder))
            read = robustness_scores.read_run(Path(folder) / "run", len(every))
            scored = robustness_scores.score(read, shown.T_world_camera[None], Plan(every, every))
            found |= {name: scored[name] for name in ("ate_m", "lost", "silent")}
        except FAILURES as problem:
            found["problem"] = f"{type(problem).__name__}: {problem}"[:300]
    return found


def measure(options: Options) -> dict[str, Any]:
    """Draw the variants and run them."""
    random = np.random.default_rng(options.seed)
    with TemporaryDirectory(prefix="variants-") as scratch:
        images = {name: original(accuracy.located(name), 0.0, Path(scratch)) for name in options.sources}
        names = [options.sources[i % len(options.sources)] for i in range(options.number)]
        variants = [drawn(name, len(images[name]), random) for name in names]
        with ThreadPoolExecutor(PROCESSES, initializer=board_runs.one_thread) as pool:
            made = pool.map(lambda v: perform(v, images[v.source], options.seed, Path(scratch)), variants)
            return {"rows": list(tqdm(made, total=len(variants), unit="variant"))}


def is_worse(row: dict[str, Any]) -> bool:
    """Return whether the plain system's path is better beyond the board's noise, or the only one."""
    ours, theirs = row["ate_m"], row["plain_ate_m"]
    return theirs is not None and (ours is None or verdict_of(QUANTITIES["ate_m"], ours, theirs, None) == "worse")


def compared(rows: list[dict[str, Any]]) -> list[str]:
    """Return how many variants there are, on how many the plain system is better, the geometric mean of the ratio of
    both ATE where both have one, and the numbers of lost and of silent frames."""
    both = [row for row in rows if row["plain_ate_m"] and row["ate_m"]]
    ratio = math.exp(np.mean([math.log(row["ate_m"] / row["plain_ate_m"]) for row in both])) if both else math.nan
    frames = [str(sum(row[name] for row in rows)) for name in ("lost", "silent")]
    return [str(len(rows)), str(sum(map(is_worse, rows))), tables.significant(ratio), *frames]


def sections(measured: dict[str, Any]) -> list[tables.Section]:
    """Return the tables of results written by this benchmark."""
    scored = [row for row in measured["figures"]["rows"] if not row["problem"]]
    of: dict[str, list[dict[str, Any]]] = {}
    for row in scored:
        of.setdefault(row["variant"][0], []).append(row)
    head = ["recording", "variants", "worse", "ATE / plain", "lost", "silent"]
    summary = [[name, *compared(rows)] for name, rows in (of | {"all": scored}).items()]
    rows = [
        [
            *row["variant"],
            f"{tables.significant(row['ate_m'] and 100.0 * row['ate_m'])}{' (worse)' if is_worse(row) else ''}",
            "diverged" if row["plain_ate_m"] is None else tables.significant(100.0 * row["plain_ate_m"]),
            str(row["lost"]), str(row["silent"]),
        ]
        for row in scored
    ]  # fmt: skip
    columns = ["recording", "frames", "image", "disturbed", "ATE, cm", "plain system", "lost", "silent"]
    return [tables.Section("By recording", head, summary), tables.Section("Variants", columns, rows)]


def main(options: Options) -> int:
    """Run, write the results, print the table; return the exit code."""
    return program.run("variants", options, measure, (options.seed,))


if __name__ == "__main__":
    program.start(main, Options)
