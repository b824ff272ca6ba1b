"""Measured poses relative to each other, one by one and in columns: hops between keyframes, edges of the pose graph."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.poses import Column, Part, Records
from sigmasplat.types import Matrix

Kind = Literal["hop", "odometry", "loop", "relocalisation", "join", "alignment"]
"""hop: from a keyframe to the one before, as tracking found it; odometry: to the next submap at a cut; loop: judged by
the pose graph, unlike the others; relocalisation: to the place where the camera was found; join: between components;
alignment: between keyframes that see the same."""


@dataclass(frozen=True, eq=False, slots=True)
class RelativePose:
    """T_a_b [4, 4] of submap or camera b in a, with an error: the true pose is exp(ξ) T_a_b, ξ = (ρ, φ), m and rad.

    a, b: numbers of submaps, −1 in a hop. information or covariance [6, 6]: of ξ, the one that was estimated; the other
    is nan, and so are both for the first keyframe of a submap. bias [6], camera [6, 4]: one standard deviation of the
    errors that are the same in all hops, of alignment in six directions, and of the stated camera (`calibration_std`).
    A loop compares a keyframe of submap a with one of submap b: `keyframes`, counted in their submaps. drift [6, 6]: of
    its covariance, the drift from the submaps' first keyframes to these two. wrong: the probability that a hop is wrong
    by more than its errors, as the images judge it.
    """

    a: int
    b: int
    T_a_b: Matrix
    information: Matrix = field(default_factory=lambda: np.full((6, 6), np.nan))
    kind: Kind = "odometry"
    keyframes: tuple[int, int] = (0, 0)
    drift: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    covariance: Matrix = field(default_factory=lambda: np.full((6, 6), np.nan))
    bias: Matrix = field(default_factory=lambda: np.zeros(6))
    camera: Matrix = field(default_factory=lambda: np.zeros((6, 4)))
    wrong: float = 0.0

    @staticmethod
    def hop(T_camera_before: Matrix, *errors: Matrix, wrong: float = 0.0) -> "RelativePose":
        """Return the motion to a keyframe from the one before, with its covariance, bias, and `camera`, if known."""
        known: dict[str, Any] = dict(zip(("covariance", "bias", "camera"), errors, strict=False))
        return RelativePose(-1, -1, T_camera_before, kind="hop", wrong=wrong, **known)

    @property
    def loop(self) -> bool:
        """Return whether the pose graph judges it."""
        return self.kind == "loop"

    @property
    def total_covariance(self) -> Matrix | None:
        """Return the covariance [6, 6] of a hop with its bias; None if it is not known."""
        return self.covariance + np.diag(self.bias**2) if np.isfinite(self.covariance).all() else None

    @property
    def measured(self) -> Matrix:
        """Return the covariance [6, 6] of the measurement alone, without drift."""
        return np.asarray(np.linalg.inv(self.information) - self.drift)


UNKNOWN_HOP = RelativePose.hop(np.eye(4))


@dataclass(eq=False)
class TrackedHops(Records[RelativePose]):
    """The hops to all keyframes, submap by submap."""

    T_camera_before = Part(np.float64, 4, 4)
    covariance = Part(np.float64, 6, 6)
    bias = Part(np.float64, 6)
    camera = Part(np.float64, 6, 4)

    def append(self, hop: RelativePose) -> None:
        """Append the hop to the next keyframe."""
        self.add(hop.T_a_b, hop.covariance, hop.bias, hop.camera)

    def _record(self, i: int) -> RelativePose:
        return RelativePose.hop(*self.values(i))


@dataclass(eq=False)
class Alignments(Records[RelativePose]):
    """Alignments between keyframes, in the order in which they were made; a is later than b."""

    a = Part(np.int64)
    b = Part(np.int64)
    T_a_b = Part(np.float64, 4, 4)
    information = Part(np.float64, 6, 6)
    bias = Part(np.float64, 6)

    def append(self, edge: RelativePose) -> None:
        """Append an alignment from its later keyframe, `edge.a`, to an earlier one."""
        self.add(edge.a, edge.b, edge.T_a_b, edge.information, edge.bias)

    def touching(self, first: int) -> list[RelativePose]:
        """Return the alignments of keyframes from row `first` on."""
        return self[int(np.searchsorted(self.rows.used[:, 0], first)) :]

    def _record(self, i: int) -> RelativePose:
        a, b, T_a_b, information, bias = self.values(i)
        return RelativePose(a, b, T_a_b, information, "alignment", bias=bias)


@dataclass(frozen=True, eq=False)
class SolvedGraph:
    """The edges that determined the final poses of keyframes, as numbers: a keyframe that submaps share is one node.

    node [K]: the node of each keyframe, −1: not in the graph. T_world_node [N, 4, 4], of which the first `fixed` are
    given. ends [E, 2]: nodes a and b of each edge; T_a_b [E, 4, 4]; information [E, 6, 6]: with the factor and weight
    of the solution; shared [E, 6, 11]: one standard deviation of each error that all edges share (`graph_errors`).
    """

    node: NDArray[np.int64]
    T_world_node: Matrix
    fixed: int
    ends: NDArray[np.int64]
    T_a_b: Matrix
    information: Matrix
    shared: Matrix


TRUSTED: tuple[Kind, ...] = ("odometry", "relocalisation", "join")
"""The kinds of edges that the pose graph does not judge."""


@dataclass(eq=False)
class Edges(Records[RelativePose]):
    """Edges in their order. An edge is made when it is read.

    loop_row: row of the loop that the edge is, or −1 minus the place of its kind in `TRUSTED`.
    """

    ends = Part(np.int64, 2)
    loop_row = Part(np.int64)
    keyframes = Part(np.int64, 2)
    T_a_b = Part(np.float64, 4, 4)
    information = Part(np.float64, 6, 6)
    drift = Part(np.float64, 6, 6)

    def append(self, edge: RelativePose, loop_row: int = 0) -> None:
        """Append an edge; loop_row: of a loop, its row among all pairs that were tried."""
        loop_row = -1 - TRUSTED.index(edge.kind) if edge.kind in TRUSTED else loop_row
        self.add(edge.a, edge.b, loop_row, edge.keyframes, edge.T_a_b, edge.information, edge.drift)

    @property
    def is_loop(self) -> NDArray[np.bool_]:
        """Return which edges are loops [E]."""
        return np.asarray(self.loop_row >= 0)

    def taken(self, chosen: NDArray[np.bool_]) -> "Edges":
        """Return a copy of some edges."""
        rows = self.rows.used[chosen]
        return Edges(Column(rows, len(rows)))

    def loop_rows(self, edges: Sequence[int]) -> NDArray[np.int64]:
        """Return the row of the loop that each of some edges is [n], below 0 for a trusted edge."""
        return self.loop_row[np.array(edges, np.intp)]

    def _record(self, i: int) -> RelativePose:
        (a, b), loop_row, keyframes, T_a_b, information, drift = self.values(i)
        kind: Kind = "loop" if loop_row >= 0 else TRUSTED[-1 - loop_row]
        return RelativePose(int(a), int(b), T_a_b, information, kind, tuple(keyframes.tolist()), drift)
