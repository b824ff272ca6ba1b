"""Time the main operations of one checkout's CPU kernels on one scene; versus.py runs this in its own process.

Prints the shortest times, ms, as JSON. The operations are those of the checkout, which can be older than this file.
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
    "keyframe_reference": "reference of a keyframe",
    "track_align": "track a frame",
}
MAPPING = "mapping iteration"
NAMES = (*WORKS.values(), MAPPING)


def measure(path: str, index: int, splats: int, width: int, threads: int, runs: int) -> dict[str, float]:
    """Return the shortest time of each operation, ms."""
    scenes, works = importlib.import_module("scenes"), importlib.import_module("works")
    works.set_up("auto", threads)
    all_works = works.Works(scenes.make_scene(path, index, splats, width))
    all_works.pose_only()  # leaves the loss gradient for `backward`
    least = {}
    for work, name in WORKS.items():
        all_works.forward()
        least[name] = works.timed(getattr(all_works, work), runs).min_ms
    return least | {MAPPING: 1e3 * min(all_works.mapping_iterations(runs))}


def main(checkout: Path, request: dict[str, Any]) -> None:
    """Import from a checkout, measure, print. Exits with a message if a module is imported from elsewhere."""
    sys.path[:0] = [str(checkout / "benchmarks"), str(checkout / "src")]
    for name in ("works", "scenes", "sigmasplat.native._core"):
        found = Path(str(importlib.import_module(name).__file__)).resolve()
        if not found.is_relative_to(checkout):
            sys.exit(f"{name} is imported from {found}, not from the checkout")
    print(json.dumps(measure(**request)))


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), json.loads(sys.argv[2]))
