"""Time the CUDA backend on maps back-projected from the built-in room's depth; beside gsplat where it is installed.

Writes benchmarks/results/gpu-<device>.json and prints its tables; benchmarks/README.md says what each figure means.

example: python benchmarks/gpu.py --quick
"""

import sys
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
    name: Annotated[str, arg(help="name of the results")] = "gpu"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measure_all(options: Options) -> dict[str, Any]:
    """Measure every scene, then a run from end to end. Raises BackendError where there is no CUDA device."""
    from gpu_works import describe_device, measure, refuse_without_device, time_slam

    refuse_without_device()
    quick, figures = options.quick, []
    sizes, maps = SIZES[: 1 if quick else None], sorted(options.splats)[: 1 if quick else None]
    for width, height in sizes:
        for splats in maps:
            figures.append(measure(width, height, splats, 7 if quick else options.runs, options.seed))
            print(f"{splats:>7} splats, {width}×{height}: done", file=sys.stderr, flush=True)
    slam = time_slam(options.slam_frames, options.seed) if options.slam_frames and not quick else None
    return {"device": describe_device(), "scenes": figures, "slam": slam}


def main(options: Options) -> int:
    """Measure, write, print; return the exit code."""
    try:
        figures = measure_all(options)
    except (SigmaSplatError, ValueError) as problem:
        print(f"gpu.py: {problem}", file=sys.stderr)
        return 2
    config = {n: v for n, v in asdict(options).items() if n != "out"}
    measured = record.results("gpu", figures, name=options.name, seeds=[options.seed], config=config)
    if not options.quick:
        print(record.write(measured, options.out), file=sys.stderr)
    print(tables.table(measured))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, config=(tyro.conf.FlagCreatePairsOff,))))
