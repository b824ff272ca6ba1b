"""Test what a variance of colour can be good for: poses in a known map with weights, and how σ² is learned.

Windows of a source, one for each seed: five keyframes are mapped at true poses, two frames between them are localised
from a disturbed pose. Colour is weighed by 1/V, by a σ² in closed form, and by an oracle (the true squared residual);
depth is as recorded, missing or wrong on half of the image, or not used. σ² is learned in five ways on the same map.
Windows are kept in runs/bench/what-variance; the command continues where it stopped.
Writes benchmarks/results/<name>-<machine>.json and prints tables.

example: python benchmarks/what_variance_is_good_for.py --sources livingroom --seeds 0 1
"""

import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import program
import record
import tyro
from what_variance_maps import MIRRORS, ROOM, Window, map_config, measure_sigma, psnr_db, sigmas_of
from what_variance_poses import measure_poses

from sigmasplat.commands.options import prepare_torch

arg = tyro.conf.arg
RECORDINGS = ("livingroom", "redkitchen", "fr1_xyz", "cubicles", "hololens")
RUNS = record.ROOT / "runs" / "bench" / "what-variance"


@dataclass(frozen=True)
class Options:
    """Test what a variance of colour can be good for."""

    sources: Annotated[tuple[str, ...], arg(help="recordings in the data folder, or the rooms")] = (
        *RECORDINGS, ROOM, MIRRORS,
    )  # fmt: skip
    width: Annotated[int, arg(help="working width, pixels")] = 160
    seeds: Annotated[tuple[int, ...], arg(help="windows of each source, 0 to 4, or rooms")] = (0, 1, 2, 3, 4)
    iterations: Annotated[int, arg(help="steps a keyframe; 3 times for the first, 4 times for all at the end")] = 20
    refit: Annotated[int, arg(help="steps of each refit of σ²")] = 60
    quick: Annotated[bool, arg(help="a minute: a room, one seed, small; no results written")] = False
    collect: Annotated[bool, arg(help="measure nothing; write the results of the windows that are done")] = False
    name: Annotated[str, arg(help="name of the results")] = "what-variance-is-good-for"
    fresh: Annotated[bool, arg(help="repeat windows that exist already")] = False
    runs: Annotated[Path, arg(help="folder of the windows that are done")] = RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    def file_of(self, source: str, seed: int) -> Path:
        """Return the file of a window."""
        return self.runs / f"{record.slug(f'{source} {seed} {self.width} {self.iterations}')}.json"


def measure_window(options: Options, source: str, seed: int) -> dict[str, Any]:
    """Map one window, score each σ² at its held-out frames, and localise two of them."""
    window = Window(source, seed, map_config(options.width, seed, options.iterations), 4 * options.iterations)
    field = window.fitted("none")
    sigmas = sigmas_of(window, field, options.refit)
    return {
        "source": source, "seed": seed, "keyframes": window.keyframes, "splats": len(field),
        "psnr_db": round(psnr_db(window, field, window.between), 2),
        "sigma": measure_sigma(window, field, sigmas), "poses": measure_poses(window, field, sigmas),
    }  # fmt: skip


def measure(options: Options) -> dict[str, Any]:
    """Measure the windows that are not done yet, the first of all sources before the second. Raises SourceError if a
    frame has no true pose."""
    prepare_torch()
    found = []
    for seed in options.seeds:
        for source in options.sources:
            kept = options.file_of(source, seed)
            if options.collect and not kept.is_file():
                continue
            if options.fresh or options.quick or not kept.is_file():
                clock = time.process_time()
                made = measure_window(options, source, seed)
                seconds = time.process_time() - clock
                print(f"{source}, seed {seed}: {made['psnr_db']} dB, {seconds:.0f} s", file=sys.stderr, flush=True)
                if options.quick:
                    found.append(made)
                    continue
                kept.parent.mkdir(parents=True, exist_ok=True)
                record.write_json(made, kept)
            found.append(json.loads(kept.read_text(encoding="utf-8")))
    return {"windows": found}


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    if options.quick:
        options = replace(options, sources=(ROOM, MIRRORS), seeds=(0,), width=96, iterations=15, refit=60)
    if options.collect:
        done = [seed for seed in options.seeds if any(options.file_of(s, seed).is_file() for s in options.sources)]
        options = replace(options, seeds=tuple(done))
    return program.run("what_variance_is_good_for", options, measure, options.seeds, not options.quick)


if __name__ == "__main__":
    program.start(main, Options)
