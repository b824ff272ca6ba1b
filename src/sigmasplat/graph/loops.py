"""All pairs of submaps that were tried as loops, in columns."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.poses import Column, Records
from sigmasplat.data.submap import Submap
from sigmasplat.graph.candidates import Candidate
from sigmasplat.graph.pose_graph import LoopVerdict
from sigmasplat.graph.registration import Registration
from sigmasplat.types import Matrix

NUMBERS = 11
"""Columns before the pose, see `Loops.rows`."""


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


@dataclass(eq=False)
class Loops(Records[Loop]):
    """All pairs that were tried, in their order. A record is made when it is read.

    rows [L, 27]: what never changes: query, database, query_frame, database_frame, similarity, gated, residual,
    overlap, localised, translation_m, rotation_deg, and T_query_database by rows; verdicts [L, 4]: accepted, number of
    the reason in `reasons`, chi2, weight.
    """

    rows: Column = field(default_factory=lambda: Column.of(np.float64, NUMBERS + 16))
    verdicts: Column = field(default_factory=lambda: Column.of(np.float64, 4))
    reasons: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._numbers = {reason: number for number, reason in enumerate(self.reasons)}

    def append(self, loop: Loop) -> None:
        """Append a pair."""
        numbers = (
            loop.query, loop.database, loop.query_frame, loop.database_frame, loop.similarity, loop.gated,
            loop.residual, loop.overlap, loop.localised, loop.translation_m, loop.rotation_deg,
        )  # fmt: skip
        self.verdicts.append(self._verdict(loop))
        self.rows.append([*numbers, *loop.T_query_database.ravel()])

    def judge(self, i: int, verdict: LoopVerdict) -> None:
        """Set the pose graph's verdict on a registered pair."""
        reason = "accepted" if verdict.accepted else f"the pose graph disagrees (χ² {verdict.chi2:.0f})"
        accepted, chi2, weight = verdict.accepted, verdict.chi2, verdict.weight
        loop = replace(self[i], accepted=accepted, reason=reason, chi2=chi2, weight=weight)
        self.verdicts.used[i] = self._verdict(loop)

    def _verdict(self, loop: Loop) -> tuple[bool, int, float, float]:
        number = self._numbers.setdefault(loop.reason, len(self._numbers))
        if number == len(self.reasons):
            self.reasons.append(loop.reason)
        return loop.accepted, number, loop.chi2, loop.weight

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """Return whether each pair is used as a loop [L]."""
        return np.asarray(self.verdicts.used[:, 0] != 0)

    def is_rejected(self, i: int) -> bool:
        """Return whether a pose graph that was solved before has rejected a pair."""
        accepted, _, chi2, _ = self.verdicts.used[i]
        return bool(np.isfinite(chi2) and not accepted)

    def copied(self) -> "Loops":
        """Return the pairs so far with the verdicts of now."""
        verdicts = Column(self.verdicts.used.copy(), len(self))
        return Loops(self.rows.first(len(self)), verdicts, list(self.reasons))

    def _record(self, i: int) -> Loop:
        row, (accepted, number, chi2, weight) = self.rows.used[i].copy(), self.verdicts.used[i].tolist()
        query, database, query_frame, database_frame, similarity, gated, *rest = row[:NUMBERS].tolist()
        residual, overlap, localised, translation_m, rotation_deg = rest
        return Loop(
            int(query), int(database), int(query_frame), int(database_frame), similarity, gated, bool(accepted),
            self.reasons[int(number)], residual, overlap, int(localised), translation_m, rotation_deg,
            row[NUMBERS:].reshape(4, 4), chi2, weight,
        )  # fmt: skip


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
