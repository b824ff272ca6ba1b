"""Run the plainest system as a peer: frames aligned to the newest keyframe, then a robust graph over the keyframes.

There is no map, and no frame is ever lost, doubtful or masked. Each frame starts at constant velocity; the finest size
alone is a second candidate beside coarse to fine, and what agrees better at full resolution is taken. A frame whose
view has changed becomes a keyframe. Each keyframe is then aligned to at most `EDGES` earlier ones that see the same.
Whatever the product does beyond this has to be better than this on every recording.

example: python benchmarks/plain.py --sources fr1_xyz livingroom
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tables
import tyro

from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import ConfigError
from sigmasplat.fit.compare import best_alignment
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.graph.pose_graph import PoseGraph, factorised
from sigmasplat.plugins.evaluation.metrics.trajectory import ate
from sigmasplat.plugins.evaluation.run_views import working_frame
from sigmasplat.plugins.sources import open_source
from sigmasplat.types import Matrix

arg = tyro.conf.arg
SOURCES = (
    "fr1_xyz", "livingroom", "redkitchen", "hololens", "cubicles", "cabinet58", f"{accuracy.SYNTHETIC},noise=1",
    "synthetic:corridor",
)  # fmt: skip
GRAY = np.array([0.299, 0.587, 0.114], np.float32)
FAR, LEAST_COMMON = 0.15, 0.75
"""A frame becomes a keyframe when its view has changed by this share of the depth plus radians, or when it sees less
than this share of the keyframe."""
EDGES, NEAR, APART, LONG = 6, 0.7, 20, 30
"""Edges of a keyframe: to the one before, to the two nearest views, and to others that are this many frames apart and
this many frames ago; views are near up to this change (share of the depth plus rotation / 0.6 rad)."""
LEAST_CLOSE, LEAST_CORRELATION, LEAST_OVERLAP = 0.85, 0.6, 0.25
"""An edge needs this agreement; that to the keyframe before is always kept."""
WEIGHT_GRAY = 0.5
ROBUST_CHI2, ROUNDS = 15.0, 12
"""Scale of the Geman–McClure loss of an edge, and steps of the solution."""
FIGURES = {"front_end_ate_m": 100.0, "ate_m": 100.0, "cpu_s": 1000.0, "graph_cpu_s": 1.0}
UNKNOWN = np.diag([0.05**2] * 3 + [0.03**2] * 3)


@dataclass(frozen=True)
class Options:
    """Run the plainest system as a peer."""

    sources: Annotated[tuple[str, ...], arg(help="recordings with truth: names in the data folder, or paths")] = SOURCES
    limit: Annotated[int, arg(help="number of frames at most, 0 = all")] = 0
    name: Annotated[str, arg(help="name of the results")] = "plain"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass(eq=False)
class PlainSystem:
    """The frames seen so far: images, poses T_world_camera, and the keyframe that each was aligned to."""

    images: list[Pyramid] = field(default_factory=list)
    poses: list[Matrix] = field(default_factory=list)
    references: list[int] = field(default_factory=list)
    keyframe: int = 0

    def step(self, frame: Frame) -> None:
        """Align a frame to the newest keyframe."""
        gray = np.ascontiguousarray(frame.color @ GRAY)
        self.images.append(Pyramid.of(gray, np.ascontiguousarray(frame.depth_m, np.float32), frame.camera))
        if not self.poses:
            self.poses.append(np.eye(4))
            self.references.append(0)
            return
        velocity = se3.inverse(self.poses[-2]) @ self.poses[-1] if len(self.poses) > 1 else np.eye(4)
        guess = se3.inverse(self.poses[-1] @ velocity) @ self.poses[self.keyframe]
        found, seen = best_alignment(self.images[self.keyframe], self.images[-1], guess, WEIGHT_GRAY)
        self.poses.append(self.poses[self.keyframe] @ se3.inverse(found.T_live_reference))
        moved = view_change(found.T_live_reference, found.depth_m, 1.0)
        if moved > FAR or seen.common < LEAST_COMMON:
            self.keyframe = len(self.poses) - 1
        self.references.append(self.keyframe)

    def solved(self) -> Matrix:
        """Return the poses [F, 4, 4] after a graph over the keyframes; edges are found twice, the second time from the
        first solution."""
        keyframes = sorted(set(self.references))
        row = {frame: number for number, frame in enumerate(keyframes)}
        T = np.array([self.poses[frame] for frame in keyframes])
        for _ in range(2):
            T = minimised(T, self.edges(keyframes, T))
        return np.array(
            [
                T[row[reference]] @ se3.inverse(self.poses[reference]) @ pose
                for reference, pose in zip(self.references, self.poses, strict=True)
            ]
        )

    def edges(self, keyframes: Sequence[int], T: Matrix) -> list[RelativePose]:
        """Align each keyframe to earlier ones, from poses T [K, 4, 4]."""
        found = []
        for i in range(1, len(keyframes)):
            for j in partners(i, keyframes, T, float(self.images[keyframes[i]].readings[0])):
                images = self.images[keyframes[j]], self.images[keyframes[i]]
                motion, seen = best_alignment(*images, se3.inverse(T[i]) @ T[j], WEIGHT_GRAY)
                agrees = seen.close >= LEAST_CLOSE and seen.correlation > LEAST_CORRELATION
                if j != i - 1 and not (agrees and motion.overlap >= LEAST_OVERLAP and not motion.degenerate):
                    continue
                covariance = motion.covariance + np.diag(motion.bias**2)
                known = covariance if np.isfinite(covariance).all() else UNKNOWN
                found.append(RelativePose(i, j, motion.T_live_reference, np.asarray(np.linalg.inv(known))))
        return found


def view_change(T_a_b: Matrix, depth_m: float, rotation_rad: float) -> float:
    """Return the motion as a share of the depth, plus the rotation in units of `rotation_rad`."""
    return float(np.linalg.norm(T_a_b[:3, 3])) / max(depth_m, 0.1) + se3.rotation_angle(T_a_b[:3, :3]) / rotation_rad


def partners(i: int, keyframes: Sequence[int], T: Matrix, depth_m: float) -> list[int]:
    """Return the earlier keyframes that keyframe i is aligned to: near in view, spread in time."""
    change = np.array([view_change(T_i_j, depth_m, 0.6) for T_i_j in se3.inverse(T[i]) @ T[:i]])
    near = [j for j in np.argsort(change, kind="stable").tolist() if change[j] < NEAR and j != i - 1]
    far = [
        j for j in near[2:]
        if keyframes[i] - keyframes[j] > LONG and all(abs(keyframes[j] - keyframes[k]) > APART for k in near[:2])
    ]  # fmt: skip
    return [i - 1, *near[:2], *far[: EDGES - 3]]


def minimised(T: Matrix, edges: Sequence[RelativePose]) -> Matrix:
    """Return the poses [K, 4, 4] that agree best with the edges, with the Geman–McClure loss."""
    if len(T) < 2:
        return T
    graph, first, T = PoseGraph(len(T), edges), T[0], se3.inverse(T[:1]) @ T
    for _ in range(ROUNDS):
        H, g = graph.normal_equations(T, (ROBUST_CHI2 / (ROBUST_CHI2 + graph.chi2(T))) ** 2)
        twists = factorised(H).solve(-g).reshape(-1, 6)
        T[1:] = se3.exp_stack(twists) @ T[1:]
        if np.abs(twists).max() < 1e-6:
            break
    return np.asarray(first @ T)


def run(path: str, limit: int = 0, truth: Trajectory | None = None) -> dict[str, Any]:
    """Run the plain system on a recording; return its figures. truth: if the recording has none itself.

    Raises ConfigError without truth.
    """
    source, settings = open_source(path, limit=limit), preset(default_preset()).input
    truth = truth or source.truth()
    if truth is None:
        raise ConfigError(f"{path} has no true path; the plain system is only scored")
    system, spent_s = PlainSystem(), 0.0
    for index in range(len(source)):
        frame = working_frame(source, settings, index)
        start = time.process_time()
        system.step(frame)
        spent_s += time.process_time() - start
    start, times_s = time.process_time(), np.array([source.timestamp_s(i) for i in range(len(source))])
    paths = {"front_end_ate_m": np.array(system.poses), "ate_m": system.solved()}
    scored: dict[str, Any] = {name: ate(Trajectory(times_s, poses), truth).rmse_m for name, poses in paths.items()}
    return scored | {
        "frames": len(source),
        "keyframes": len(set(system.references)),
        "cpu_s": spent_s / len(source),
        "graph_cpu_s": time.process_time() - start,
    }


def measure(options: Options) -> dict[str, Any]:
    """Run every recording."""
    return {"rows": [{"name": name} | run(accuracy.located(name), options.limit) for name in options.sources]}


def sections(measured: dict[str, Any]) -> list[tables.Section]:
    """Return the table of results written by this benchmark."""
    head = ["recording", "frames", "keyframes", "front end, ATE cm", "graph, ATE cm", "CPU, ms a frame", "graph, CPU s"]
    rows = [
        [
            row["name"], str(row["frames"]), str(row["keyframes"]),
            *(tables.significant(row[name] * factor) for name, factor in FIGURES.items()),
        ]
        for row in measured["figures"]["rows"]
    ]  # fmt: skip
    return [tables.Section("Plain system", head, rows, "One thread.")]


def main(options: Options) -> int:
    """Run, write the results, print the table; return the exit code."""
    return program.run("plain", options, measure, ())


if __name__ == "__main__":
    program.start(main, Options)
