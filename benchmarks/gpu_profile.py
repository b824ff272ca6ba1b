"""Record where the time of each fit goes on CUDA: kernels, launches, copies and waits of one iteration.

Writes benchmarks/results/gpu-profile-<machine>.json and prints its tables.

example: python benchmarks/gpu_profile.py --splats 77000
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import program
import record
import tables
import torch
import tyro
from gpu import card
from gpu_works import FRAME, GpuWorks, describe_device, refuse_without_device, steps_of, timed
from scenes import make_scene
from tables import Section, significant
from torch.autograd import DeviceType

from sigmasplat.errors import SigmaSplatError

arg = tyro.conf.arg
FITS = ("mapping_iterations", "tracking_iterations", "launched_tracking_iterations", "align", "both_all")
BARE = ("mapping_iterations", "launched_tracking_iterations", "align")
"""Fits without a CUDA graph, for another program that looks at every launch."""
RUNS = 3
CALLS = {
    "launches": ("cudaLaunchKernel", "cudaLaunchKernelExC", "cuLaunchKernel", "cuLaunchKernelEx", "cudaGraphLaunch"),
    "copies": ("cudaMemcpyAsync", "cudaMemsetAsync"),
    "waits": ("cudaStreamSynchronize", "cudaEventSynchronize", "cudaDeviceSynchronize"),
}
"""Calls of the driver and of the runtime, by what they do."""


@dataclass(frozen=True)
class Options:
    """Record where the time of each fit goes on CUDA."""

    splats: int = 77_000
    size: Annotated[tuple[int, int], arg(help="width and height of the image")] = (640, 480)
    bare: Annotated[bool, arg(help="only run the fits twice, for ncu or nsys; nothing is written")] = False
    traces: Annotated[Path | None, arg(help="folder for the timelines, read by ui.perfetto.dev")] = None
    seed: int = 0
    name: Annotated[str, arg(help="name of the results")] = "gpu-profile"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def profiled(works: GpuWorks, name: str, traces: Path | None) -> dict[str, Any]:
    """Run one fit under the profiler, warm; return times and counts of one of its iterations."""
    work, steps = getattr(works, name), steps_of(name)
    wall = timed(work, RUNS, works.device).median_ms / steps
    with torch.profiler.profile(activities=torch.profiler.supported_activities()) as profile:
        work()
        torch.cuda.synchronize()
    events = profile.key_averages()
    if traces is not None:
        traces.mkdir(parents=True, exist_ok=True)
        profile.export_chrome_trace(str(traces / f"{name}.json.gz"))
    kernels = [
        {"kernel": e.key[:100], "runs": e.count / steps, "us": e.self_device_time_total / steps}
        for e in events
        if e.device_type == DeviceType.CUDA
    ]
    kernels.sort(key=lambda kernel: -float(kernel["us"]))
    called = {e.key: e.count / steps for e in events if e.device_type == DeviceType.CPU}
    counts = {what: sum(called.get(name, 0.0) for name in names) for what, names in CALLS.items()}
    busy_ms = sum(float(kernel["us"]) for kernel in kernels) / 1e3
    return {"work": name, "wall_ms": wall, "busy_ms": busy_ms, **counts, "kernels": kernels}


def measured_so_far(options: Options) -> Iterator[dict[str, Any]]:
    """Profile fit after fit; yield all figures so far after each."""
    refuse_without_device()
    width, height = options.size
    path = f"synthetic:frames=200,width={width},height={height}"
    scene = make_scene(path, FRAME, options.splats, width, options.seed)
    works = GpuWorks(scene, torch.device("cuda", torch.cuda.current_device()))
    if options.bare:
        for name in BARE + BARE:
            getattr(works, name)()
        torch.cuda.synchronize()
        return
    figures: dict[str, Any] = {"device": describe_device(), "works": []}
    for name in FITS:
        figures["works"].append(profiled(works, name, options.traces))
        yield figures


# ---- tables ----

SHOWN = 12


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results: one iteration of each fit, then its kernels that take longest."""
    figures, config = measured["figures"], measured["config"]
    note = f"{config['splats'] // 1000} k splats, {config['size'][0]}×{config['size'][1]}; {card(figures['device'])}"
    head = ["one iteration of", "wall, ms", "GPU busy, ms", *CALLS]
    made = [Section("Iterations", head, [_cells(work) for work in figures["works"]], note)]
    for work in figures["works"]:
        rows = [[k["kernel"], significant(k["runs"]), significant(k["us"])] for k in work["kernels"][:SHOWN]]
        made += [Section(work["work"], ["kernel", "runs", "µs"], rows)] if rows else []
    return made


def _cells(work: dict[str, Any]) -> list[str]:
    return [work["work"], *(significant(work[name]) for name in ("wall_ms", "busy_ms", *CALLS))]


def main(options: Options) -> int:
    """Profile, write after each fit, print; return the exit code."""
    measured = None
    try:
        for figures in measured_so_far(options):
            measured = program.keep("gpu_profile", figures, options, [options.seed])
    except (SigmaSplatError, ValueError) as problem:
        return program.refuse("gpu_profile", problem)
    if measured is not None:
        print(tables.table(measured))
    return 0


if __name__ == "__main__":
    program.start(main, Options)
