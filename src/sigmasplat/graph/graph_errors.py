"""The errors of keyframes in their solved graph, as linear functions of the errors of its edges."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from sigmasplat.config import InputConfig
from sigmasplat.config.input import RENDERED
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.camera_errors import CameraErrors
from sigmasplat.data.relative_pose import RelativePose, SolvedGraph
from sigmasplat.graph.pose_graph import Sensitivity
from sigmasplat.types import Matrix

CALIBRATION = 0.01
"""Standard deviation of the scale of depth and of the focal length, as a share, and of the image centre, in focal
lengths. It is assumed (ours): files do not say how well a camera was calibrated."""
STAMP = 12.0**-0.5
"""Standard deviation of the time of a frame, in frames: it lies anywhere between two of them."""
NEAREST_M = 1e-3
"""Points behind a camera are not seen."""
PREFIX = "graph_"
"""Begins the names of the arrays of a `SolvedGraph` in a checkpoint."""


@dataclass(frozen=True, eq=False)
class GraphErrors:
    """Two kinds of error move the nodes. That of an edge's measurement, whose size the redundancy of the graph has
    measured, is independent from edge to edge. Others are the same in all edges, and no redundancy shows them."""

    graph: SolvedGraph

    @lru_cache(maxsize=64)  # noqa: B019 - the object lives as long as one evaluation or export
    def of(self, node: int) -> Matrix:
        """Return the error of T_world_node: a matrix [6, 6 E + 11] to multiply with standard normal twists that all
        nodes share."""
        G = self._sensitivity.of(node)
        independent, same = G @ self._roots, (G @ self.graph.shared).sum(0)
        return np.concatenate([np.swapaxes(independent, 0, 1).reshape(6, -1), same], 1)

    @cached_property
    def _sensitivity(self) -> Sensitivity:
        g = self.graph
        rows = zip(g.ends.tolist(), g.T_a_b, g.information, strict=True)
        edges = [RelativePose(a, b, T_a_b, information) for (a, b), T_a_b, information in rows]
        return Sensitivity(g.T_world_node, edges, g.fixed)

    @cached_property
    def _roots(self) -> Matrix:
        """Return W [E, 6, 6] with W Wᵀ = the covariance of each edge. Information below 1e-7 of the largest is raised
        to it: it is the rounding error of an inverse, and can be negative."""
        values, vectors = np.linalg.eigh(self.graph.information)
        least = 1e-7 * values[:, -1:]
        return np.asarray(vectors / np.sqrt(np.maximum(values, least))[:, None])


def calibration_std(settings: InputConfig, camera: Camera) -> Matrix | None:
    """Return one standard deviation [4] of the scale of depth and the focal length, as shares, and of the image centre,
    in focal lengths: as measured, but for the scale, which images cannot show. None for rendered images."""
    measured = CameraErrors.given(settings.calibrate).std
    if settings.sensor == RENDERED:
        return None
    if measured is None:
        return np.full(4, CALIBRATION)
    return np.array([CALIBRATION, *measured[:3]]) * [1.0, 1.0, *[camera.width / camera.fx] * 2]


def shared_errors(
    edges: Sequence[RelativePose], rates: Matrix, points: Sequence[Matrix], calibration: Matrix | None
) -> Matrix:
    """Return one standard deviation of each error that all edges share [E, 6, 11], as twists of T_a_b: the systematic
    error of alignment in six directions; of the scale of depth, the focal length, the image centre to the right and
    down, and the time of a frame.

    rates [N, 6]: the motion of each node's camera in the time of a frame, a twist in its axes; points [P, 3]: what each
    node sees, m, in its camera; calibration [4]: of `calibration_std`. The last five are parameters that are
    considered, not estimated (Schmidt 1966). Rendered images do not have them.
    """
    if not edges:
        return np.empty((0, 6, 11))
    T_a_b, bias = (np.array([getattr(edge, name) for edge in edges]) for name in ("T_a_b", "bias"))
    shared = np.concatenate([bias[:, None] * np.eye(6), np.zeros((len(edges), 6, 5))], 2)
    if calibration is not None:
        a, b = np.array([(edge.a, edge.b) for edge in edges]).T
        shared[:, :, 6:10] = [calibration * moved_by_camera(edge.T_a_b, points[edge.b]) for edge in edges]
        shared[:, :, 10] = STAMP * ((se3.adjoint(T_a_b) @ rates[b][..., None])[..., 0] - rates[a])
    return shared


def moved_by_camera(T_a_b: Matrix, points: Matrix) -> Matrix:
    """Return how T_a_b moves with the scale of depth, the focal length, and the image centre [6, 4]: left twists per
    share, and per focal length.

    points [P, 3]: what camera b sees. The points of both images move with the parameters; the twist is that of the best
    rigid motion between them. Its residuals are those of alignment: in pixels across, in the noise of depth along.
    """
    in_a = points @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    seen = in_a[:, 2] > NEAREST_M
    in_a, points = in_a[seen], points[seen]
    right, down, ahead = np.eye(3)
    stretched = np.eye(3), np.diag(right + down), np.outer(right, ahead), np.outer(down, ahead)
    moved = np.array([in_a @ S.T - points @ S.T @ T_a_b[:3, :3].T for S in stretched])  # [4, P, 3]
    turns = np.cross(np.eye(3)[:, None], in_a)  # [3, P, 3]: about each axis
    J = np.concatenate([np.broadcast_to(np.eye(3)[:, None], (3, *in_a.shape)), turns])
    weights = in_a[:, 2:] ** -np.array([1.0, 1.0, 2.0])
    J, moved = ((each * weights).reshape(len(each), -1) for each in (J, moved))
    return np.asarray(np.linalg.solve(J @ J.T + 1e-9 * np.eye(6), J @ moved.T))


def written(graph: SolvedGraph | None) -> dict[str, Any]:
    """Return the arrays that a checkpoint keeps of a graph, if there is one."""
    return {} if graph is None else {PREFIX + f.name: np.atleast_1d(getattr(graph, f.name)) for f in fields(graph)}


def read(arrays: Mapping[str, Any]) -> SolvedGraph | None:
    """Return the graph that a checkpoint keeps; None if it has none, as that of an older version."""
    if f"{PREFIX}node" not in arrays:
        return None
    values = {f.name: arrays[PREFIX + f.name] for f in fields(SolvedGraph)}
    return SolvedGraph(**values | {"fixed": int(values["fixed"][0])})


def root(covariance: Matrix) -> Matrix:
    """Return W [..., 6, 6] with W Wᵀ = a covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])
