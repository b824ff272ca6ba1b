"""Time the CUDA backend on maps back-projected from the depth of the built-in room; gsplat too if installed.

Writes benchmarks/results/gpu-<device>.json and prints its tables; benchmarks/README.md says what each figure means.

example: python benchmarks/gpu.py --quick
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import program
import record
import tables
import tyro
from tables import Section, significant

from sigmasplat.errors import SigmaSplatError

arg = tyro.conf.arg
SIZES = ((640, 480), (1200, 680))


@dataclass(frozen=True)
class Options:
    """Time the CUDA backend on maps back-projected from the depth of the built-in room."""

    splats: Annotated[tuple[int, ...], arg(help="sizes of the map")] = (77_000, 300_000, 1_000_000)
    sizes: Annotated[tuple[tuple[int, int], ...], arg(help="widths and heights of the image")] = SIZES
    runs: Annotated[int, arg(help="runs of each operation; at least 7 for published medians")] = 50
    seed: int = 0
    quick: Annotated[bool, arg(help="a minute: one small map and image, 7 runs, no results written")] = False
    alone: Annotated[bool, arg(help="leave out gsplat")] = False
    name: Annotated[str, arg(help="name of the results")] = "gpu"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measured_so_far(options: Options) -> Iterator[dict[str, Any]]:
    """Measure scene after scene; yield all figures so far after each.

    Raises BackendError without a CUDA device.
    """
    from gpu_works import describe_device, measure, refuse_without_device

    refuse_without_device()
    figures: dict[str, Any] = {"device": describe_device(), "scenes": []}
    quick, peer = options.quick, not options.alone
    sizes, maps = options.sizes[: 1 if quick else None], sorted(options.splats)[: 1 if quick else None]
    for width, height in sizes:
        for splats in maps:
            figures["scenes"].append(measure(width, height, splats, 7 if quick else options.runs, options.seed, peer))
            print(f"{splats:>7} splats, {width}×{height}: done", file=sys.stderr, flush=True)
            yield figures


# ---- tables ----


COLUMNS = (
    ("forward, all outputs", "forward_all"),
    ("colour + depth", "forward_color_depth"),
    ("forward + backward, all outputs", "both_all"),
    ("colour + depth", "both_color_depth"),
    ("pose only", "both_pose"),
    ("tracking iteration", "tracking_iteration"),
    ("kernel by kernel", "launched_tracking_iteration"),
    ("mapping iteration", "mapping_iteration"),
    ("align", "align"),
)
GOALS_MS = {"mapping_iteration": 0.35, "tracking_iteration": 0.10, "align": 0.4}
"""On the smallest map at 640×480."""
LEAST_SPEED = 1.5
"""Of forward + backward, at 640×480, in terms of gsplat's."""
Figures = dict[str, Any]


def sections(measured: Figures) -> list[Section]:
    """Return the tables of results: times, gsplat, the goals of issue 59."""
    figures = measured["figures"]
    scenes = figures["scenes"]
    note = card(figures["device"])
    made = [
        Section(
            "Times, ms", ["splats, image", *(title for title, _ in COLUMNS), "peak, MiB"], list(_times(scenes)), note
        )
    ]
    if any(scene["gsplat"] for scene in scenes):
        head = ["splats, image", "ours, forward", "gsplat", "ours, forward + backward", "gsplat", "mean difference"]
        made.append(Section("Beside gsplat, colour and depth, ms", head, list(_peers(scenes))))
    goals = list(_goals(figures))
    if goals:
        made.append(Section("Goals", ["figure", "goal", "measured", "reached"], goals))
    return made


def card(device: Figures) -> str:
    """Name the device and what runs on it, in one line."""
    return f"{device['name']}, driver {device['driver'] or 'unknown'}, torch {device['torch']}."


def _name(scene: Figures) -> str:
    return f"{scene['splats'] // 1000} k, {scene['width']}×{scene['height']}"


def _ms(scene: Figures, work: str) -> float:
    return float(scene["works"][work]["median_ms"])


def _times(scenes: list[Figures]) -> Iterator[list[str]]:
    for scene in scenes:
        yield [_name(scene), *(significant(_ms(scene, work)) for _, work in COLUMNS), f"{scene['peak_mib']:.0f}"]


def _peers(scenes: list[Figures]) -> Iterator[list[str]]:
    for scene in scenes:
        if peer := scene["gsplat"]:
            ours = [_ms(scene, "forward_color_depth"), _ms(scene, "both_color_depth")]
            pairs = zip(ours, (peer["forward"], peer["both"]), strict=True)
            times = [significant(value) for mine, theirs in pairs for value in (mine, theirs["median_ms"])]
            yield [_name(scene), *times, significant(peer["mean_color_difference"])]


def _goals(figures: Figures) -> Iterator[list[str]]:
    scenes = [scene for scene in figures["scenes"] if scene["width"] == SIZES[0][0]]
    titles = {work: title for title, work in COLUMNS}
    for work, most in GOALS_MS.items() if scenes else ():
        yield row(f"{titles[work]}, ms, {_name(scenes[0])}", "≤", most, _ms(scenes[0], work))
    for scene in scenes:
        if peer := scene["gsplat"]:
            speed = peer["both"]["median_ms"] / _ms(scene, "both_color_depth")
            yield row(f"gsplat / ours, forward + backward, {_name(scene)}", "≥", LEAST_SPEED, speed)


def row(what: str, sign: str, goal: float, found: float) -> list[str]:
    """Judge a figure by its goal: the cells of a row."""
    held = found <= goal if sign == "≤" else found >= goal
    return [what, f"{sign} {significant(goal)}", significant(found), "yes" if held else "**no**"]


def main(options: Options) -> int:
    """Measure, write after each scene, print; return the exit code."""
    try:
        for figures in measured_so_far(options):
            measured = program.keep("gpu", figures, options, [options.seed], not options.quick)
    except (SigmaSplatError, ValueError) as problem:
        return program.refuse("gpu", problem)
    print(tables.table(measured))
    return 0


if __name__ == "__main__":
    program.start(main, Options)
