"""Time the CUDA backend on maps back-projected from the built-in room's depth; beside gsplat where it is installed.

Writes benchmarks/results/gpu-<device>.json and prints its tables; benchmarks/README.md says what each figure means.

example: python benchmarks/gpu.py --quick
"""

import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import record
import tables
import tyro

from sigmasplat.errors import SigmaSplatError

arg = tyro.conf.arg
SIZES = ((640, 480), (1200, 680))


@dataclass(frozen=True)
class Options:
    """Time the CUDA backend on maps back-projected from the built-in room's depth."""

    splats: Annotated[tuple[int, ...], arg(help="sizes of the map")] = (100_000, 300_000, 1_000_000)
    runs: Annotated[int, arg(help="runs of each piece of work; at least 7 for a median to publish")] = 50
    slam_frames: Annotated[int, arg(help="frames of the run from end to end; 0 = none")] = 200
    seed: int = 0
    quick: Annotated[bool, arg(help="a minute: one small map and image, 7 runs, no SLAM; nothing is written")] = False
    alone: Annotated[bool, arg(help="leave gsplat out")] = False
    name: Annotated[str, arg(help="name of the results")] = "gpu"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measured_so_far(options: Options) -> Iterator[dict[str, Any]]:
    """Measure scene after scene, then a run from end to end; yield all there is after each.

    Raises BackendError where there is no CUDA device.
    """
    from gpu_works import describe_device, measure, refuse_without_device, time_slam

    refuse_without_device()
    figures: dict[str, Any] = {"device": describe_device(), "scenes": [], "slam": None}
    quick, peer = options.quick, not options.alone
    sizes, maps = SIZES[: 1 if quick else None], sorted(options.splats)[: 1 if quick else None]
    for width, height in sizes:
        for splats in maps:
            figures["scenes"].append(measure(width, height, splats, 7 if quick else options.runs, options.seed, peer))
            print(f"{splats:>7} splats, {width}×{height}: done", file=sys.stderr, flush=True)
            yield figures
    if options.slam_frames and not quick:
        figures["slam"] = time_slam(options.slam_frames, options.seed)
        yield figures


def main(options: Options) -> int:
    """Measure, write as it goes, print; return the exit code."""
    config = {n: v for n, v in asdict(options).items() if n != "out"}
    try:
        for figures in measured_so_far(options):
            measured = record.results("gpu", figures, name=options.name, seeds=[options.seed], config=config)
            path = None if options.quick else record.write(measured, options.out)
    except (SigmaSplatError, ValueError) as problem:
        print(f"gpu.py: {problem}", file=sys.stderr)
        return 2
    print(path or "nothing is written", file=sys.stderr)
    print(tables.table(measured))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, config=(tyro.conf.FlagCreatePairsOff,))))
