"""Time one checkout's CPU kernels, the main pieces of work on one scene: versus.py runs this in a process of its own.

Prints the least times, ms, as JSON. The works are those of the checkout itself, older or newer than this file.
"""

import importlib
import json
import sys
from pathlib import Path
from typing import Any

WORKS = {
    "forward_all": "forward, all outputs",
    "forward_color_depth": "colour + depth",
    "pose_only": "forward + loss + pose gradient",
    "backward": "full backward",
}
MAPPING = "mapping iteration"
NAMES = (*WORKS.values(), MAPPING)


def measure(path: str, index: int, splats: int, width: int, threads: int, runs: int) -> dict[str, float]:
    """Return the least time of each work, ms."""
    scenes, works = importlib.import_module("scenes"), importlib.import_module("works")
    works.set_up("auto", threads)
    all_works = works.Works(scenes.make_scene(path, index, splats, width))
    all_works.pose_only()  # leaves the loss that `backward` carries back
    least = {}
    for work, name in WORKS.items():
        all_works.forward()
        least[name] = works.timed(getattr(all_works, work), runs).min_ms
    return least | {MAPPING: 1e3 * min(all_works.mapping_iterations(runs))}


def main(checkout: Path, request: dict[str, Any]) -> None:
    """Import from a checkout, measure, print. Exits with a line where what is imported lies elsewhere."""
    sys.path[:0] = [str(checkout / "benchmarks"), str(checkout / "src")]
    for name in ("works", "scenes", "sigmasplat.native._core"):
        found = Path(str(importlib.import_module(name).__file__)).resolve()
        if not found.is_relative_to(checkout):
            sys.exit(f"{name} is not there, only {found}")
    print(json.dumps(measure(**request)))


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), json.loads(sys.argv[2]))
