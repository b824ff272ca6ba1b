"""Leave out parts of the graph of keyframes, one at a time: what each gives to the path and costs.

Edges per keyframe, the window that is solved at each keyframe, the search for loops, the covariance of each edge as its
weight. Every run is made in memory in a process of its own, with one thread and without the final map.

No setting leaves out one part alone, so most variants replace something of the package in their process: `Variant`
says what. Without loops, keyframes are still aligned to near ones of other submaps. A moved name stops the benchmark.
Writes benchmarks/results/graph-ablation-<machine>.json and prints tables: rows are variants, columns recordings.

example: python benchmarks/graph_ablation.py --sources fr1_xyz livingroom --variants "as it is" "3 edges"
"""

import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any
from unittest import mock

import accuracy
import board_runs
import numpy as np
import program
import record
import tyro
from accuracy_tables import failed_runs
from cpu import alone
from finished_run import FinishedRun, run_facts
from plain import SOURCES
from tables import Section, significant

from sigmasplat.commands.options import Settings
from sigmasplat.config.find_preset import default_preset, preset as preset_of
from sigmasplat.config.submaps import LoopConfig
from sigmasplat.config.text import override, split_settings
from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.final import stores
from sigmasplat.graph import keyframe_graph
from sigmasplat.plugins.sources import open_source
from sigmasplat.system.slam import Slam
from sigmasplat.types import Matrix

arg = tyro.conf.arg
NEVER = 1_000_000
EQUAL = np.diag(1.0 / np.repeat([0.01, np.deg2rad(0.5)], 3) ** 2)
"""Information of each edge without covariance weights: 1 cm and 0.5°. Factors by kind and the robust loss remain."""


@dataclass(frozen=True)
class Variant:
    """What is left of the graph.

    edges: most alignments of a keyframe (`LoopConfig.alignments`); window: whether the newest keyframes move when one
    is added (`GrowingGraph.solved`); loops: whether loops between submaps are searched for (`loops.min_interval`);
    weights: whether edges count by their covariance (`keyframe_graph.solve`).
    """

    edges: int = LoopConfig.alignments
    window: bool = True
    loops: bool = True
    weights: bool = True

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Replace parts of the package in this process."""
        with ExitStack() as stack:
            stack.enter_context(mock.patch.object(LoopConfig, "alignments", self.edges))
            if not self.window:
                stack.enter_context(mock.patch.object(keyframe_graph.GrowingGraph, "solved", unsolved))
            if not self.weights:
                for module in (keyframe_graph, stores):
                    stack.enter_context(mock.patch.object(module, "solve", solve_unweighted))
            yield


VARIANTS = {
    "as it is": Variant(),
    **{f"{count} edge{'s' * (count != 1)}": Variant(edges=count) for count in (0, 1, 3, 6, 10)},
    "solved at the end only": Variant(window=False),
    "without loops": Variant(loops=False),
    "equal weights": Variant(weights=False),
    "hops alone": Variant(edges=0, loops=False),
}


def unsolved(graph: Any, T_world_keyframe: Matrix, hops: Sequence[RelativePose], first: int) -> Matrix:
    """Return the poses of the window as they are."""
    return T_world_keyframe[first:]


def solve_unweighted(
    T_world_keyframe: Matrix, edges: Sequence[RelativePose], fixed: int = 1,
    solve: Callable[..., keyframe_graph.KeyframeSolution] = keyframe_graph.solve,
) -> keyframe_graph.KeyframeSolution:  # fmt: skip
    """Solve a graph whose edges all have the same information."""
    return solve(T_world_keyframe, [replace(edge, information=EQUAL) for edge in edges], fixed)


@dataclass(frozen=True)
class Options:
    """Leave out parts of the graph of keyframes, one at a time."""

    sources: Annotated[tuple[str, ...], arg(help="recordings with truth: names in the data folder, or paths")] = SOURCES
    variants: Annotated[tuple[str, ...], arg(help="names of variants")] = tuple(VARIANTS)
    seeds: Annotated[tuple[int, ...], arg(help="random seeds")] = (0,)
    limit: Annotated[int, arg(help="number of frames at most, 0 = all")] = 0
    preset: Annotated[str, arg(help="preset to start from")] = default_preset()
    settings: Settings = ()
    quick: Annotated[bool, arg(help="print the tables, write no results", help_behavior_hint="")] = False
    name: Annotated[str, arg(help="name of the results")] = "graph-ablation"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measure(source: str, variant: Variant, seed: int, options: Options) -> dict[str, Any]:
    """Run one variant in this process; return its figures. Raises SigmaSplatError."""
    board_runs.one_thread()
    settings = {"final.iterations": "0", "seed": str(seed), **split_settings(options.settings)}
    settings |= {} if variant.loops else {"loops.min_interval": str(NEVER)}
    recording = open_source(accuracy.located(source), limit=options.limit)
    with variant.in_place():
        slam, start = Slam(override(preset_of(options.preset), settings)), time.process_time()
        for frame in recording:
            slam.step(frame)
        slam.finish()
        spent_s, graph = time.process_time() - start, slam.atlas.graph
        facts = run_facts(FinishedRun.of(slam), recording)
    windows = (facts["poses"] or {}).get("windows") or {}
    return {
        **{name: facts[name] for name in ("frames", "lost", "keyframes", "submaps", "ate_m", "poses")},
        "windows_in": windows.get("position_coverage_90"), "windows_k": windows.get("position_k"),
        "loops": sum(loop.accepted for loop in slam.loops), "edges": None if graph is None else len(graph.ends),
        "cpu_s": spent_s / facts["frames"],
    }  # fmt: skip


def measure_all(options: Options) -> dict[str, Any]:
    """Run every variant. Raises ConfigError for an unknown one."""
    if unknown := set(options.variants) - VARIANTS.keys():
        raise ConfigError(f"no variant {unknown.pop()!r}; there are {', '.join(map(repr, VARIANTS))}")
    runs = list[dict[str, Any]]()
    for source in options.sources:
        for name in options.variants:
            for seed in options.seeds:
                try:
                    found = {"problem": None} | alone(measure, source, VARIANTS[name], seed, options)
                except SigmaSplatError as problem:
                    found = {"problem": str(problem)}
                runs.append({"source": source, "variant": name, "seed": seed} | found)
                said = found["problem"] or f"ATE {significant(100.0 * (found['ate_m'] or np.nan))} cm"
                print(f"{source}, {name}, seed {seed}: {said}", file=sys.stderr, flush=True)
    return {"runs": runs}


FIGURES = {
    "ATE, cm": ("ate_m", 100.0), "windows of 50: position in the 90 % ellipsoid, %": ("windows_in", 100.0),
    "windows of 50: k": ("windows_k", 1.0), "lost frames": ("lost", 1.0), "edges": ("edges", 1.0),
    "closed loops": ("loops", 1.0), "CPU, ms a frame": ("cpu_s", 1000.0),
}  # fmt: skip
"""Titles of the tables, with the figure and the factor to its unit."""


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return one table for each figure: means over seeds."""
    runs = measured["figures"]["runs"]
    sources, variants = ([*dict.fromkeys(run[key] for run in runs)] for key in ("source", "variant"))

    def mean(source: str, variant: str, figure: str, factor: float) -> str:
        found = [r.get(figure) for r in runs if (r["source"], r["variant"]) == (source, variant)]
        values = [value for value in found if value is not None]
        return significant(factor * statistics.fmean(values) if values else None)

    made = [
        Section(title, ["variant", *sources], [[v, *(mean(s, v, *of) for s in sources)] for v in variants], "")
        for title, of in FIGURES.items()
    ]
    return [s for s in (*made, failed_runs(runs, lambda r: "{source}, {variant}, seed {seed}".format(**r))) if s.rows]


def main(options: Options) -> int:
    """Measure, write the results, print the tables; return the exit code."""
    return program.run("graph_ablation", options, measure_all, options.seeds, write=not options.quick)


if __name__ == "__main__":
    program.start(main, Options)
