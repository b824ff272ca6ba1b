"""How tracking found each keyframe from the one before it."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from sigmasplat.data.column import Column, Records
from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.types import Matrix


@dataclass(eq=False)
class TrackedHops(Records[RelativePose]):
    """The hops to all keyframes, submap by submap. rows [K, 59]: submap, then T_camera_before, covariance and bias by
    rows."""

    POSE_COLUMNS: ClassVar[slice] = slice(1, 17)
    """The columns of `rows` that hold a pose."""

    rows: Column = field(default_factory=lambda: Column.of(np.float64, 1 + 16 + 36 + 6))

    @staticmethod
    def of(known: Iterable[tuple[int, RelativePose]]) -> "TrackedHops":
        """Return hops in their order, each with the submap of its keyframe."""
        hops = TrackedHops()
        for submap, hop in known:
            hops.append(submap, hop)
        return hops

    def append(self, submap: int, hop: RelativePose) -> None:
        """Append the hop to the next keyframe, which is in a submap that is not before the last one."""
        self.rows.append([submap, *hop.T_a_b.ravel(), *hop.covariance.ravel(), *hop.bias])

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

    def _record(self, i: int) -> RelativePose:
        row = self.rows.used[i]
        T_camera_before, covariance = row[1:17].reshape(4, 4).copy(), row[17:53].reshape(6, 6).copy()
        return RelativePose.hop(T_camera_before, covariance, row[53:].copy())


@dataclass(frozen=True, eq=False)
class Hops:
    """The motion to each of K keyframes from the one before it in its submap, as tracking found it:
    T_camera_before [K, 4, 4], covariance [K, 6, 6], bias [K, 6]."""

    T_camera_before: Matrix
    covariance: Matrix
    bias: Matrix

    def known(self, row: int) -> Matrix | None:
        """Return the covariance [6, 6] that tracking estimated for one hop, with its bias; None if it is not known."""
        covariance = self.covariance[row]
        return covariance + np.diag(self.bias[row] ** 2) if np.isfinite(covariance).all() else None
