"""Covariance of every pose of a path: errors of hops between keyframes, added along submaps and through the pose graph.

All errors are small. Three kinds of error move a hop:
- the error that alignment estimates, and the random part of the disagreement between tracking and mapping, which moves
  keyframes after they were tracked: independent from hop to hop;
- the mean of this disagreement over all hops: the same in all hops, in the camera's axes;
- the systematic error of alignment, which its estimate does not contain (`fit.align.BIAS_PX`), and what is wrong with
  the stated camera (`graph_errors`): the same in all hops.
The disagreement is measured in the run itself, so no constant describes how well tracking and mapping agree. Once the
graph of keyframes is solved, the errors of its edges take the place of those of the hops (`graph_errors`).

A pose is a linear function of all errors, and so is the motion between two poses. The closed loops are part of this
function: it is the pose graph's solution.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas, between_keyframes
from sigmasplat.data.relative_pose import Edges, RelativePose, SolvedGraph, TrackedHops
from sigmasplat.graph import graph_errors
from sigmasplat.graph.closer import LoopCloser
from sigmasplat.graph.graph_errors import GraphErrors, root
from sigmasplat.graph.pose_graph import Sensitivity
from sigmasplat.tracking.drift import UNKNOWN, hop_errors
from sigmasplat.types import Matrix

Numbers = NDArray[np.int64]
BIAS, CAMERA, MEAN = -3, -2, -1
"""Columns of the errors that are the same in all hops."""


def recorded(atlas: Atlas, edges: Edges) -> dict[str, Tensor]:
    """Return what a checkpoint keeps of the errors of a path; edges: the trusted ones and the accepted loops."""
    counts = atlas.keyframe_poses.counts
    arrays = {
        "frame_keyframe": atlas.places.keyframe,
        "T_keyframe_camera": atlas.places.T_keyframe_camera,
        "keyframe_submap": np.repeat(np.arange(len(counts)), counts),
        "T_submap_keyframe": atlas.keyframe_poses.stacked(),
        "hop_T_camera_before": atlas.hops.T_camera_before,
        "hop_covariance": atlas.hops.covariance,
        "hop_bias": atlas.hops.bias,
        "hop_camera": atlas.hops.camera,
        "edge_submaps": edges.ends,
        "edge_T_a_b": edges.T_a_b,
        "edge_information": edges.information,
        "edge_is_loop": edges.is_loop,
        "edge_keyframes": edges.keyframes,
        "edge_drift": edges.drift,
        **graph_errors.written(atlas.graph),
    }
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


@dataclass(frozen=True, eq=False)
class PathCovariance:
    """The errors of a path of F frames, K keyframes, S submaps, and edges between submaps.

    anchors [S, 4, 4]: T_world_submap; components [S]; frame_submap, frame_keyframe [F], the latter counted in its
    submap, T_keyframe_camera [F, 4, 4], is_keyframe [F]; keyframe_submap [K], T_submap_keyframe [K, 4, 4]; hops to the
    keyframes; edges: the trusted ones and the accepted loops.
    graph: that of the keyframes, if it determined their final poses; T_final [F, 4, 4]: the final poses of the frames.
    """

    anchors: Matrix
    components: Numbers
    frame_submap: Numbers
    frame_keyframe: Numbers
    T_keyframe_camera: Matrix
    is_keyframe: NDArray[np.bool_]
    keyframe_submap: Numbers
    T_submap_keyframe: Matrix
    hops: TrackedHops
    edges: tuple[RelativePose, ...]
    graph: SolvedGraph | None = None
    T_final: Matrix | None = None

    @staticmethod
    def of_keyframes(atlas: Atlas, edges: Sequence[RelativePose]) -> "PathCovariance":
        """Return the errors of the keyframes alone, without other frames."""
        none, counts = np.empty(0, np.int64), atlas.keyframe_poses.counts
        return PathCovariance(
            np.array(atlas.anchors), np.array(atlas.components, np.int64), none, none, np.empty((0, 4, 4)),
            none.astype(bool), np.repeat(np.arange(len(counts)), counts), atlas.keyframe_poses.stacked(), atlas.hops,
            tuple(edges),
        )  # fmt: skip

    @staticmethod
    def of(checkpoint: Mapping[str, Tensor]) -> "PathCovariance | None":
        """Read the errors of a path from a checkpoint; None if an older version wrote it."""
        if "hop_covariance" not in checkpoint:
            return None
        read = {name: tensor.numpy() for name, tensor in checkpoint.items()}
        camera = read.get("hop_camera", np.zeros((len(read["hop_bias"]), 6, 4)))  # older checkpoints lack it
        edges = zip(
            read["edge_submaps"].tolist(), read["edge_T_a_b"], read["edge_information"], read["edge_is_loop"],
            read["edge_keyframes"].tolist(), read["edge_drift"], strict=True,
        )  # fmt: skip
        return PathCovariance(
            read["T_world_submap"], read["submap_component"], read["frame_submap"], read["frame_keyframe"],
            read["T_keyframe_camera"], np.isin(np.arange(len(read["frame_keyframe"])), read["keyframes"]),
            read["keyframe_submap"], read["T_submap_keyframe"],
            TrackedHops.joined(read["hop_T_camera_before"], read["hop_covariance"], read["hop_bias"], camera),
            tuple(
                RelativePose(a, b, T, information, "loop" if loop else "odometry", (in_a, in_b), drift)
                for (a, b), T, information, loop, (in_a, in_b), drift in edges
            ),
            graph_errors.read(read), read.get("T_world_camera"),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.frame_submap)

    def of_frame(self, frame: int) -> Matrix:
        """Return the covariance [6, 6] of the left twist (ρ, φ), m and rad, of T_world_camera.

        The world is the first camera of the frame's component, whose covariance is 0.
        """
        error, own = self._error_of(frame)
        return np.asarray(error @ error.T + own)

    def of_keyframe(self, submap: int, keyframe: int) -> Matrix:
        """Return the covariance [6, 6] of a keyframe's pose, as `of_frame`; keyframe: counted in its submap."""
        row = int(self._first[submap]) + keyframe
        node = -1 if self.graph is None else int(self.graph.node[row])
        error = self._error_of_keyframe(row) if node < 0 else self._graph_errors.of(node)
        return np.asarray(error @ error.T)

    def between(self, a: int, b: int) -> Matrix:
        """Return the covariance [6, 6] of the left twist of T_a_b, the pose of frame b in the camera of frame a.

        Both frames must be in the same component.
        """
        if a == b:
            return np.zeros((6, 6))
        (error_a, own_a), (error_b, own_b) = self._error_of(a), self._error_of(b)
        A, error = se3.adjoint(se3.inverse(self.T_world_camera[a])), error_b - error_a
        return np.asarray(A @ (error @ error.T + own_a + own_b) @ A.T)

    @cached_property
    def T_world_camera(self) -> Matrix:
        """Return the poses of the frames [F, 4, 4]."""
        if self.T_final is not None:
            return self.T_final
        return np.asarray(self.anchors[self.frame_submap] @ self.T_submap_keyframe[self._row] @ self.T_keyframe_camera)

    # ---- rows of keyframes ----

    @cached_property
    def _first(self) -> Numbers:
        """Return the row of each submap's first keyframe [S]."""
        return np.asarray(np.searchsorted(self.keyframe_submap, np.arange(len(self.anchors))))

    @cached_property
    def _row(self) -> Numbers:
        """Return the row of each frame's keyframe [F]."""
        return np.asarray(self._first[self.frame_submap] + self.frame_keyframe)

    def _rows_of_hops(self, submap: int, last: int | None = None) -> slice:
        """Return the rows of the hops in a submap, up to a keyframe."""
        end = int(np.searchsorted(self.keyframe_submap, submap, side="right")) if last is None else last + 1
        return slice(int(self._first[submap]) + 1, end)

    # ---- errors as linear functions of standard normal twists ----

    def _error_of(self, frame: int) -> tuple[Matrix, Matrix]:
        """Return the error of a frame's pose: a matrix [6, 6n] to multiply with n standard normal twists, which other
        frames share, and the covariance [6, 6] of the rest."""
        A = se3.adjoint(self.T_world_camera[frame])
        own = np.zeros((6, 6)) if self.is_keyframe[frame] else A @ self._hop_of_frame(frame) @ A.T
        row, share = int(self._row[frame]), float(self._after[1][frame])
        if self.graph is None or self.graph.node[row] < 0:
            return self._error_of_keyframe(row), own
        rows = row, int(self._after[0][frame])
        before, after = (self._graph_errors.of(int(self.graph.node[r])) for r in rows)
        return (1.0 - share) * before + share * after, own

    @cached_property
    def _graph_errors(self) -> GraphErrors:
        assert self.graph is not None
        return GraphErrors(self.graph)

    @cached_property
    def _after(self) -> tuple[Numbers, Matrix]:
        """Return the row of the keyframe after each frame [F], and its share in the frame's motion: the graph's
        corrections are interpolated (`Atlas`)."""
        last = np.searchsorted(self.keyframe_submap, self.frame_submap, side="right") - 1
        return between_keyframes(self._row, last)

    def _hop_of_frame(self, frame: int) -> Matrix:
        """Return the covariance [6, 6] of a frame's motion from its keyframe: that of the hop to the next one, which is
        tracked against the same image; at the end of a submap, that of the hop before; in a submap without hops, the
        newest one before it. Computing it for each frame would double the time of tracking."""
        rows, row = self._rows_of_hops(int(self.frame_submap[frame])), int(self._row[frame])
        near = [r for r in (row + 1, row) if rows.start <= r < rows.stop]
        known = (self.hops[r].total_covariance for r in near or range(row, -1, -1))
        return next((covariance for covariance in known if covariance is not None), UNKNOWN)

    @lru_cache(maxsize=64)  # noqa: B019 - the object lives as long as one evaluation or export
    def _error_of_keyframe(self, row: int) -> Matrix:
        """Return the error of a keyframe's pose: that of its submap and that of the hops to it."""
        submap = int(self.keyframe_submap[row])
        error = self._error_of_submap(submap).copy()
        self._add_hops(error, se3.adjoint(self.anchors[submap]), self._rows_of_hops(submap, row))
        return error.reshape(6, -1)

    @lru_cache(maxsize=8)  # noqa: B019
    def _error_of_submap(self, submap: int) -> Matrix:
        """Return the error of an anchor as a matrix [6, n, 6]: n is K hops, then all edges, then `_shared`."""
        count = len(self.keyframe_submap)
        error = np.zeros((6, count + len(self.edges) + len(self._shared), 6))
        submaps, numbers, sensitivity = self._graph(int(self.components[submap]))
        if sensitivity is None:
            return error
        A = se3.adjoint(self.anchors[submaps[0]])
        for number, G in zip(numbers, sensitivity.of(submaps.index(submap)), strict=True):
            edge = self.edges[number]
            hops = self._rows_of_hops(edge.a)
            if not edge.loop and np.array_equal(edge.T_a_b, self.T_submap_keyframe[hops.stop - 1]):
                self._add_hops(error, A @ G, hops)  # to the last keyframe of its submap: the error is that of the hops
            else:
                error[:, count + number] += A @ G @ root(edge.measured)
                self._add_drift(error, A @ G, edge)
        return error

    def _add_hops(self, error: Matrix, A: Matrix, rows: slice) -> None:
        """Add the errors of a chain of hops, transformed by A [6, 6]."""
        error[:, rows] += np.swapaxes(A @ self._independent[rows], 0, 1)
        for shared, column in zip(self._shared, (BIAS, CAMERA, MEAN), strict=True):
            error[:, column] += A @ shared[rows].sum(0)

    def _add_drift(self, error: Matrix, A: Matrix, edge: RelativePose) -> None:
        """Add the errors of T_a_b of a loop that come from the hops to its two keyframes, transformed by A [6, 6]."""
        in_a, in_b = edge.keyframes
        self._add_hops(error, A, self._rows_of_hops(edge.a, int(self._first[edge.a]) + in_a))
        self._add_hops(error, -A @ se3.adjoint(edge.T_a_b), self._rows_of_hops(edge.b, int(self._first[edge.b]) + in_b))

    @cached_property
    def _disagreement(self) -> tuple[Matrix, Matrix]:
        """Return mean [6] and covariance [6, 6] of the twists from the tracked hops to the final ones."""
        rows = np.flatnonzero(np.isfinite(self.hops.covariance).all((1, 2)))
        if not len(rows):
            return np.zeros(6), np.zeros((6, 6))
        T_final = se3.inverse(self.T_submap_keyframe[rows]) @ self.T_submap_keyframe[rows - 1]
        moved = se3.log_stack(T_final @ se3.inverse(self.hops.T_camera_before[rows]))
        mean = moved.mean(0)
        return np.asarray(mean), np.asarray((moved - mean).T @ (moved - mean) / len(moved))

    @cached_property
    def _independent(self) -> Matrix:
        """Return the independent errors of the hops [K, 6, 6], in the frames of their submaps."""
        spread = self._disagreement[1]
        known = np.isfinite(self.hops.covariance).all((1, 2), keepdims=True)
        roots = root(np.where(known, self.hops.covariance + spread, UNKNOWN))
        return np.asarray(-se3.adjoint(self.T_submap_keyframe) @ roots)

    @cached_property
    def _shared(self) -> tuple[Matrix, ...]:
        """Return the errors that are the same in all hops [K, 6, 6], in the frames of their submaps: of bias, of the
        camera, and the mean disagreement."""
        A, mean = -se3.adjoint(self.T_submap_keyframe), np.zeros((6, 6))
        mean[:, 0] = self._disagreement[0]
        return A * self.hops.bias[:, None], A @ np.pad(self.hops.camera, ((0, 0), (0, 0), (0, 2))), A @ mean

    @cache  # noqa: B019
    def _graph(self, component: int) -> tuple[list[int], list[int], Sensitivity | None]:
        """Return the submaps of a component, the numbers of its edges, and how their errors move the submaps, if it has
        edges."""
        submaps = np.flatnonzero(self.components == component).tolist()
        node = {submap: i for i, submap in enumerate(submaps)}
        numbers = [i for i, edge in enumerate(self.edges) if edge.a in node]
        edges = [replace(e, a=node[e.a], b=node[e.b]) for e in (self.edges[i] for i in numbers)]
        poses = se3.inverse(self.anchors[submaps[:1]]) @ self.anchors[submaps]
        return submaps, numbers, Sensitivity(poses, edges) if edges else None


# ---- the newest pose, while frames arrive ----

FIRST_HOP = hop_errors()
"""Covariance of a frame's motion from its keyframe before any motion between keyframes was measured, m² and rad²."""


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """What the covariance of a new pose needs: of_keyframe [6, 6] of the newest keyframe's pose in the world, and hop
    [6, 6] of a frame's motion from a keyframe, both of left twists."""

    of_keyframe: Matrix
    hop: Matrix

    def of(self, T_world_camera: Matrix, hops: int) -> Matrix:
        """Return the covariance [6, 6] of position and rotation in the axes of the world, m² and rad², of a pose that
        is so many independent motions away from the keyframe."""
        A, J = se3.adjoint(T_world_camera), se3.displacement(T_world_camera)
        return np.asarray(J @ (self.of_keyframe + hops * (A @ self.hop @ A.T)) @ J.T)


NO_ERRORS = PoseErrors(np.zeros((6, 6)), FIRST_HOP)
"""At the first frame."""


@dataclass(eq=False)
class NewestCovariance:
    """Computes the errors of new poses. Those of the keyframes are computed again only after a keyframe."""

    _state: bytes = b""
    _errors: PoseErrors = NO_ERRORS

    def errors(self, atlas: Atlas, closer: LoopCloser) -> PoseErrors:
        """Return the errors for poses relative to the newest keyframe."""
        submap, keyframe = len(atlas.keyframe_poses) - 1, len(atlas.keyframe_poses.last) - 1
        counts = np.array([submap, keyframe, atlas.keyframe_poses.total, *atlas.components])
        state = counts.tobytes() + (atlas.anchors[-1] @ atlas.keyframe_poses.last[-1]).tobytes()
        if state != self._state:
            path = PathCovariance.of_keyframes(atlas, closer.valid)
            known = (hop.total_covariance for hop in reversed(atlas.hops))
            # a frame is tracked from its keyframe in the same way as the newest keyframe that has a covariance
            hop = next((covariance for covariance in known if covariance is not None), FIRST_HOP)
            self._errors = PoseErrors(path.of_keyframe(submap, keyframe), hop)
            self._state = state
        return self._errors
