"""Count what the CUDA backend asks of a device per iteration and per frame: kernels, waits of the host, copies.

Needs no device: the program runs on what stands in for one in the tests (tests/backend/stand_in.py), where an operator
of torch counts as one kernel. Writes benchmarks/results/gpu-counts-<machine>.json and prints its table.

example: python benchmarks/gpu_counts.py --quick
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import gpu_works
import numpy as np
import program
import record
import torch
import tyro
from scenes import make_scene
from tables import Section, significant

from sigmasplat.config.find_preset import configured
from sigmasplat.plugins.sources import open_source
from sigmasplat.system.slam import Slam

arg = tyro.conf.arg
COLUMNS = ("kernels", "of torch", "waits", "copies", "pageable")
ROUNDS = {"mapping_iterations": ("ITERATIONS", 2, 4), "launched_tracking_iterations": ("TRACKING_ITERATIONS", 9, 25)}
"""Fits, the constant of gpu_works that sets their iterations, and two numbers of iterations; the difference counts."""
Counts = dict[str, float]


@dataclass(frozen=True)
class Options:
    """Count what the CUDA backend asks of a device, without one."""

    width: Annotated[int, arg(help="of the image; its height is three quarters")] = 160
    splats: Annotated[int, arg(help="of the fits")] = 1000
    frames: Annotated[int, arg(help="of each preset")] = 8
    presets: tuple[str, ...] = ("sigma", "cgslam-tum")
    quick: Annotated[bool, arg(help="48 pixels wide, 6 frames, no results written")] = False
    name: Annotated[str, arg(help="name of the results")] = "gpu-counts"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def counted(device: Any, work: Callable[[], object]) -> Counts:
    """Return what a piece of work asks of the stand-in device."""
    device.forget()
    work()
    ours = [name for name in device.launches if not name.startswith("torch.")]
    pageable = sum(copy.waited for copy in device.copies)
    found = (len(device.launches), len(device.launches) - len(ours), len(device.waits), len(device.copies), pageable)
    return dict(zip(COLUMNS, map(float, found), strict=True))


def per_iteration(device: Any, works: Any, name: str) -> Counts:
    """Return what one iteration more of a fit asks."""
    constant, few, more = ROUNDS[name]
    both = []
    for rounds in (few, more):
        setattr(gpu_works, constant, rounds)
        both.append(counted(device, getattr(works, name)))
    return {column: (both[1][column] - both[0][column]) / (more - few) for column in COLUMNS}


def fits(device: Any, width: int, splats: int) -> dict[str, Counts]:
    """Count one iteration of each fit, and one alignment."""
    scene = make_scene(f"synthetic:frames=200,width={width},height={width * 3 // 4}", 100, splats, width, 0)
    works = gpu_works.GpuWorks(scene, torch.device("cuda", 0))
    works.mapping_iterations()  # the first one measures how many pairs there are
    found = {name.removesuffix("s").removeprefix("launched_"): per_iteration(device, works, name) for name in ROUNDS}
    return found | {"align": counted(device, works.align)}


def frames(device: Any, preset: str, width: int, count: int) -> dict[str, Counts]:
    """Run a preset; return the medians of frames that are only tracked, and of those that are mapped, the first ones
    aside."""
    source = open_source(f"synthetic:frames=200,width={width},height={width * 3 // 4}")
    given = {"backend": "cuda", "input.width": width, "tracking.iterations": 25}
    slam, rows = Slam(configured(preset, given)), dict[str, list[Counts]]()
    for index in range(count):
        frame, steps = source.frame(index), list[Any]()
        found = counted(device, lambda frame=frame, steps=steps: steps.append(slam.step(frame)))  # type: ignore[misc]
        if index > 1:
            rows.setdefault("mapped" if steps[0].is_keyframe else "tracked", []).append(found)
    return {
        f"{preset}, {kind} frame": {c: float(np.median([row[c] for row in these])) for c in COLUMNS}
        for kind, these in rows.items()
    }


def measure(options: Options) -> dict[str, Any]:
    """Count everything on the stand-in device."""
    sys.path.append(str(record.ROOT / "tests" / "backend"))
    from emulated_cuda import Emulator
    from sigmasplat.plugins.cuda import descent
    from stand_in import library_in, standing_in

    descent.repeatable = lambda work, device: work  # the stand-in has no graphs
    with TemporaryDirectory() as folder:
        library, emulator = library_in(Path(folder)), Emulator(Path(folder))
        with standing_in(emulator, library) as device:
            return {"rows": count_all(device, options)}


def count_all(device: Any, o: Options) -> list[dict[str, Any]]:
    """Return a row for each part: its name and its counts."""
    width, splats, count = (48, 100, 6) if o.quick else (o.width, o.splats, o.frames)
    found = fits(device, width, splats)
    for preset in o.presets:
        found |= frames(device, preset, width, count)
    return [{"part": part, **counts} for part, counts in found.items()]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the table of results."""
    rows = [[row["part"], *(significant(row[c]) for c in COLUMNS)] for row in measured["figures"]["rows"]]
    note = "An operator of torch counts as one kernel. Without CUDA graphs, which replay launches together."
    return [Section("What is asked of a device", ["part", *COLUMNS], rows, note)]


def main(options: Options) -> int:
    """Count, write, print; return the exit code."""
    return program.run("gpu_counts", options, measure, write=not options.quick)


if __name__ == "__main__":
    program.start(main, Options)
