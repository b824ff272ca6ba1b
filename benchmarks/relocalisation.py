"""Measure how often a camera is found again from sparse features, and the CPU time this takes.

pairs: the pose of a frame relative to a given other frame of the same sequence. The two are at least 40 frames apart,
at most 45° apart, and show at least 30 % of the same surface, by true poses and depth. A pose is right if it is within
10 cm and 5° of the true one.
map: the live frames of these pairs, searched for in a map of every fifth frame of the sequence, except the 40 frames
before and after the searched one. The keyframes of the map have true poses; their images are all that the search knows.
Retrieval, pose, alignment and verdict are those of SLAM (`slam/localisation`).
Writes benchmarks/results/relocalisation-<machine>.json and prints tables; benchmarks/README.md says what each figure
means.

example: python benchmarks/relocalisation.py --quick
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import accuracy
import numpy as np
import program
import record
import torch
import tyro
from known_map import TrueMap
from numpy.typing import NDArray
from tracking import relative_error, true_poses

from sigmasplat.config.find_preset import default_preset, preset as preset_of
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.env import opencv
from sigmasplat.errors import SourceError
from sigmasplat.fit.target import gray_of
from sigmasplat.input.source import Source
from sigmasplat.plugins.sources import open_source
from sigmasplat.tracking.features import Extractor, Features, landmarks_of, pose_from_landmarks

arg = tyro.conf.arg
Matrix = NDArray[np.float64]
APART, OVERLAP, TURN_DEG = 40, 0.3, 45.0
RIGHT_CM, RIGHT_DEG = 10.0, 5.0
DEPTH_RANGE_M = (0.1, 8.0)
WORKING_WIDTH = 320
"""Landmarks take their depth from an image of this width, as in SLAM."""
THUMBNAIL = 8
"""Overlap is computed on every eighth pixel in each direction of the working image."""
TRIES_PER_PAIR = 400
SUSPICIOUS = 15
"""A wrong pose with at least this number of inliers is counted: the number of inliers does not show that it is
wrong."""

Experiment = Literal["pairs", "map"]


@dataclass(frozen=True)
class Options:
    """Measure how often a camera is found again from sparse features."""

    experiments: Annotated[tuple[Experiment, ...], arg(help="which ones to run")] = ("pairs", "map")
    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = (
        "redkitchen",
        "hololens",
        "livingroom",
    )
    pairs: Annotated[tuple[int, ...], arg(help="number of pairs in each sequence")] = (100, 80, 80)
    seeds: Annotated[tuple[int, ...], arg(help="random seeds: each chooses other pairs")] = (0, 1, 2)
    map_seeds: Annotated[tuple[int, ...], arg(help="the seeds whose pairs are searched for in the map")] = (0,)
    preset: Annotated[str, arg(help="preset that aligns and verifies")] = default_preset()
    quick: Annotated[bool, arg(help="a minute: ten pairs of each sequence, no results written")] = False
    name: Annotated[str, arg(help="name of the results")] = "relocalisation"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass(frozen=True, eq=False)
class Pair:
    """Two frames of a sequence, numbered from 0, and the true motion T_live_reference."""

    reference: int
    live: int
    T_live_reference: Matrix


def choose_pairs(source: Source, poses: Matrix, count: int, seed: int) -> list[Pair]:
    """Draw different pairs of frames at random; poses are the true T_world_camera. Raises SourceError if too few frames
    see the same surface."""
    random, depths = np.random.default_rng(seed), dict[int, tuple[NDArray[np.float32], Camera]]()

    def thumbnail(i: int) -> tuple[NDArray[np.float32], Camera]:
        if i not in depths:
            frame = source.frame(i).prepared(WORKING_WIDTH // THUMBNAIL, *DEPTH_RANGE_M)
            depths[i] = frame.depth_m, frame.camera
        return depths[i]

    found, drawn = list[Pair](), set[tuple[int, int]]()
    for _ in range(TRIES_PER_PAIR * count):
        a, b = (int(i) for i in random.integers(len(poses), size=2))
        T = se3.inverse(poses[b]) @ poses[a]
        if abs(a - b) < APART or (a, b) in drawn or np.degrees(se3.rotation_angle(T[:3, :3])) > TURN_DEG:
            continue
        drawn.add((a, b))
        if overlap(*thumbnail(a), *thumbnail(b), T) >= OVERLAP:
            found.append(Pair(a, b, T))
        if len(found) == count:
            return found
    raise SourceError(f"{source.name}: only {len(found)} of {count} pairs of frames see the same surface")


def overlap(first: NDArray[np.float32], camera: Camera, second: NDArray[np.float32], other: Camera, T: Matrix) -> float:
    """Return the share of the first image's readings that the second one measures too, within 5 %."""
    valid = first > 0
    points = camera.rays()[valid].astype(np.float64) * first[valid][:, None]
    points = points @ T[:3, :3].T + T[:3, 3]
    z = np.maximum(points[:, 2], 1e-6)
    u = np.rint(other.fx * points[:, 0] / z + other.cx).astype(int)
    v = np.rint(other.fy * points[:, 1] / z + other.cy).astype(int)
    inside = (points[:, 2] > DEPTH_RANGE_M[0]) & (u >= 0) & (v >= 0) & (u < other.width) & (v < other.height)
    seen = second[v[inside], u[inside]]
    return float((np.abs(seen - z[inside]) < 0.05 * z[inside]).sum() / max(int(valid.sum()), 1))


class Finder:
    """The features of one sequence: finds, matches, computes poses, and adds up the CPU time."""

    def __init__(self, source: Source) -> None:
        self.source, self.extractor = source, Extractor()
        self.seconds = {"find": 0.0, "match": 0.0, "pose": 0.0}
        self.calls = dict.fromkeys(self.seconds, 0)
        self._found: dict[int, tuple[Features, Frame]] = {}

    def features(self, i: int) -> tuple[Features, Frame]:
        """Return the features of frame i and the working frame, from memory if they were found before."""
        if i not in self._found:
            frame = self.source.frame(i)
            gray = np.rint(gray_of(frame.color) * 255.0).astype(np.uint8)
            small = frame.prepared(WORKING_WIDTH, *DEPTH_RANGE_M)
            self._found[i] = self._timed("find", self.extractor.find, gray, frame.camera), small
        return self._found[i]

    def pose(self, pair: Pair, seed: int) -> dict[str, Any]:
        """Return inliers and error of the pose of a pair; no error if none was found."""
        (reference, far), (live, _) = self.features(pair.reference), self.features(pair.live)
        landmarks = landmarks_of(reference, far.depth_m, far.camera)
        pairs = self._timed("match", self.extractor.match, landmarks.features, live)
        found = self._timed("pose", pose_from_landmarks, landmarks, live, pairs, seed)
        measured: dict[str, Any] = {"frames": [pair.reference, pair.live], "matches": len(pairs)}
        if found is None:
            return measured | {"inliers": 0, "right": False}
        error = relative_error(found.T_live_reference, pair.T_live_reference)
        return measured | {"inliers": found.inliers, "right": is_right(error)} | error

    def cpu_ms(self) -> dict[str, float]:
        """Return the mean CPU time of each part, milliseconds."""
        return {name: round(1e3 * self.seconds[name] / max(self.calls[name], 1), 2) for name in self.seconds}

    def _timed(self, part: str, function: Callable[..., Any], *arguments: Any) -> Any:
        clock = time.process_time()
        answer = function(*arguments)
        self.seconds[part] += time.process_time() - clock
        self.calls[part] += 1
        return answer


def measure_sequence(path: str, count: int, options: Options) -> dict[str, Any]:
    """Measure pairs and map on the same frames of a sequence. Raises SourceError if too few see the same surface."""
    source = open_source(accuracy.located(path))
    poses = true_poses(source, [frame.timestamp_s for frame in source])
    chosen = {seed: choose_pairs(source, poses, count, seed) for seed in options.seeds}
    measured: dict[str, Any] = {"source": source.name, "pairs": count}
    if "pairs" in options.experiments:
        measured["given"] = measure_pairs(source, chosen)
    if "map" in options.experiments:
        frames = sorted({pair.live for seed in options.map_seeds for pair in chosen[seed]})
        measured["map"] = search_map(source, poses, frames, options)
    return measured


def measure_pairs(source: Source, chosen: dict[int, list[Pair]]) -> dict[str, Any]:
    """Compute the poses of all pairs."""
    finder = Finder(source)
    found = [finder.pose(pair, seed) | {"seed": seed} for seed, pairs in chosen.items() for pair in pairs]
    measured = {**summary(found), "cpu_ms": finder.cpu_ms(), "poses": found}
    print(f"{source.name}: {measured['right_percent']} % {measured['cpu_ms']}", file=sys.stderr)
    return measured


def search_map(source: Source, poses: Matrix, frames: list[int], options: Options) -> dict[str, Any]:
    """Search for frames in a map of keyframes with true poses."""
    known = TrueMap(source, poses, preset_of(options.preset))
    found = [known.search(i) for i in frames]
    right = [is_right(each) for each in found]
    counts = {"right": sum(right), "false": sum(each["found"] for each in found) - sum(right)}
    measured: dict[str, Any] = {f"{name}_percent": percent(value, len(found)) for name, value in counts.items()}
    measured["cpu_ms"] = round(float(np.median([each["cpu_ms"] for each in found])), 1)
    print(f"{source.name}, map: {measured}", file=sys.stderr)
    return measured | {"frames": len(frames), "poses": found}


def is_right(pose: dict[str, Any]) -> bool:
    """Return whether a pose was found and is near the true one."""
    return bool(pose.get("translation_cm", np.inf) < RIGHT_CM and pose["rotation_deg"] < RIGHT_DEG)


def percent(part: int, whole: int) -> float:
    """Return a share in percent."""
    return round(100.0 * part / max(whole, 1), 1)


def summary(poses: list[dict[str, Any]]) -> dict[str, Any]:
    """Return shares of right and of confidently wrong poses, percent, and the median error of the right ones."""
    right = [pose for pose in poses if pose["right"]]
    wrong = [pose for pose in poses if not pose["right"] and pose["inliers"] >= SUSPICIOUS]
    medians = {
        name: round(float(np.median([pose[name] for pose in right])), 3) if right else None
        for name in ("translation_cm", "rotation_deg")
    }
    shares = {"right_percent": len(right), "wrong_percent": len(wrong)}
    return {name: percent(value, len(poses)) for name, value in shares.items()} | medians


def measure(options: Options) -> dict[str, Any]:
    """Measure every sequence."""
    opencv().setNumThreads(1)
    torch.set_num_threads(1)
    counts = dict(zip(options.sources, options.pairs, strict=True))
    return {"sequences": [measure_sequence(path, count, options) for path, count in counts.items()]}


def main(options: Options) -> int:
    """Measure, keep the results unless quick, print their tables."""
    if options.quick:
        options = replace(options, pairs=(10,) * len(options.sources), seeds=(0,), map_seeds=(0,))
    return program.run("relocalisation", options, measure, options.seeds, write=not options.quick)


if __name__ == "__main__":
    program.start(main, Options)
