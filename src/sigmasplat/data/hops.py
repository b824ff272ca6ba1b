"""How tracking found each keyframe from the one before it."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np

from sigmasplat.data.column import Column, Records
from sigmasplat.types import Matrix


class Hop(NamedTuple):
    """The motion T_camera_before [4, 4] from the keyframe before to a keyframe, as tracking found it.

    covariance [6, 6]: of its left twist (ρ, φ), m and rad; nan if it is not known, as for the first keyframe of a
    submap. bias [6]: standard deviation of the error that is the same in all hops.
    """

    T_camera_before: Matrix
    covariance: Matrix
    bias: Matrix


UNKNOWN_HOP = Hop(np.eye(4), np.full((6, 6), np.nan), np.zeros(6))


@dataclass(eq=False)
class TrackedHops(Records[Hop]):
    """The hops to all keyframes, submap by submap. rows [K, 59]: submap, then T_camera_before, covariance and bias by
    rows."""

    POSE_COLUMNS: ClassVar[slice] = slice(1, 17)
    """The columns of `rows` that hold a pose."""

    rows: Column = field(default_factory=lambda: Column.of(np.float64, 1 + 16 + 36 + 6))

    @staticmethod
    def of(known: Iterable[tuple[int, Hop]]) -> "TrackedHops":
        """Return hops in their order, each with the submap of its keyframe."""
        hops = TrackedHops()
        for submap, hop in known:
            hops.append(submap, hop)
        return hops

    def append(self, submap: int, hop: Hop) -> None:
        """Append the hop to the next keyframe, which is in a submap that is not before the last one."""
        self.rows.append([submap, *hop.T_camera_before.ravel(), *hop.covariance.ravel(), *hop.bias])

    def begins_submap(self, i: int) -> bool:
        """Return whether a keyframe is the first one of its submap; no hop leads to it."""
        submap = self.rows.used[:, 0]
        return bool(i == 0 or submap[i] != submap[i - 1])

    @property
    def T_camera_before(self) -> Matrix:
        """Return the motion of each hop [K, 4, 4]."""
        return self.rows.used[:, 1:17].reshape(-1, 4, 4).copy()

    @property
    def covariance(self) -> Matrix:
        """Return the covariance of each hop [K, 6, 6]."""
        return self.rows.used[:, 17:53].reshape(-1, 6, 6).copy()

    @property
    def bias(self) -> Matrix:
        """Return the bias of each hop [K, 6]."""
        return self.rows.used[:, 53:].copy()

    def _record(self, i: int) -> Hop:
        row = self.rows.used[i]
        return Hop(row[1:17].reshape(4, 4).copy(), row[17:53].reshape(6, 6).copy(), row[53:].copy())
