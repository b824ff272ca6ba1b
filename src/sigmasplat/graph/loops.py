"""All pairs of submaps that were tried as loops, in columns."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sigmasplat.data import se3
from sigmasplat.data.poses import Column, Part, Records
from sigmasplat.data.submap import Submap
from sigmasplat.graph.candidates import Candidate
from sigmasplat.graph.pose_graph import LoopVerdict
from sigmasplat.graph.registration import Registration
from sigmasplat.types import Matrix


@dataclass(frozen=True, eq=False, slots=True)
class Loop:
    """A pair of submaps that was tried as a loop, and the result: a record for the log, also of a refused pair, which
    has no `RelativePose` in the pose graph.

    query, database: submaps; query_frame, database_frame: the frames of their most similar keyframes; similarity,
    gated: of these keyframes (VarSplat §4); residual, overlap, localised: of the registration; translation_m,
    rotation_deg: the difference between T_query_database [4, 4] and the poses before; chi2, weight: verdict of the pose
    graph; accepted: whether the loop is used.
    """

    query: int
    database: int
    query_frame: int
    database_frame: int
    similarity: float
    gated: float
    accepted: bool
    reason: str
    residual: float
    overlap: float
    localised: int
    translation_m: float
    rotation_deg: float
    T_query_database: Matrix
    chi2: float = float("nan")
    weight: float = float("nan")

    def record(self) -> dict[str, Any]:
        """Return plain values, T_query_database as 4 rows."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__} | {
            "T_query_database": self.T_query_database.tolist()
        }


NUMBERS = tuple(name for name in Loop.__dataclass_fields__ if name != "reason")


@dataclass(eq=False)
class Loops(Records[Loop]):
    """All pairs that were tried, in their order. A record is made when it is read. reasons: one of each pair."""

    query = Part(np.int64)
    database = Part(np.int64)
    query_frame = Part(np.int64)
    database_frame = Part(np.int64)
    similarity = Part(np.float64)
    gated = Part(np.float64)
    accepted = Part(np.bool_)
    residual = Part(np.float64)
    overlap = Part(np.float64)
    localised = Part(np.int64)
    translation_m = Part(np.float64)
    rotation_deg = Part(np.float64)
    T_query_database = Part(np.float64, 4, 4)
    chi2 = Part(np.float64)
    weight = Part(np.float64)

    reasons: list[str] = field(default_factory=list)

    def append(self, loop: Loop) -> None:
        """Append a pair."""
        self.rows.append(self._row(loop))
        self.reasons.append(loop.reason)

    def judge(self, i: int, verdict: LoopVerdict) -> None:
        """Set the pose graph's verdict on a registered pair."""
        accepted, chi2, weight = verdict.accepted, verdict.chi2, verdict.weight
        self.rows.used[i] = self._row(replace(self[i], accepted=accepted, chi2=chi2, weight=weight))
        self.reasons[i] = "accepted" if accepted else f"the pose graph disagrees (χ² {chi2:.0f})"

    def _row(self, loop: Loop) -> Matrix:
        return self.row_of(*(getattr(loop, name) for name in NUMBERS))

    def is_rejected(self, i: int) -> bool:
        """Return whether a pose graph that was solved before has rejected a pair."""
        loop = self[i]
        return bool(np.isfinite(loop.chi2) and not loop.accepted)

    def copied(self) -> "Loops":
        """Return the pairs so far with the verdicts of now."""
        return Loops(Column(self.rows.used.copy(), len(self)), list(self.reasons))

    def _record(self, i: int) -> Loop:
        return Loop(**dict(zip(NUMBERS, self.values(i), strict=True)), reason=self.reasons[i])


def described(best: Candidate, a: Submap, b: Submap, found: Registration, known: Matrix) -> Loop:
    """Return the loop record of a registration of submaps a and b; best: their most similar keyframes; known: T_a_b
    [4, 4] before it."""
    seen_from = b.T_submap_camera[best.database_keyframe]
    moved = se3.inverse(known @ seen_from) @ found.T_a_b @ seen_from
    return Loop(
        a.index, b.index, a.frames[best.query_keyframe], b.frames[best.database_keyframe], best.similarity,
        best.gated, found.accepted, found.reason, found.residual, found.overlap, found.localised,
        float(np.linalg.norm(moved[:3, 3])), float(np.rad2deg(se3.rotation_angle(moved[:3, :3]))), found.T_a_b,
    )  # fmt: skip
