"""Descriptors of the keyframes of all finished submaps, in one array."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.column import Column, Records
from sigmasplat.types import Matrix

Descriptors = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SubmapDescriptor:
    """Descriptors of a finished submap.

    index: its number; descriptors [n, D]: one per keyframe, unit norm; opacity_ratio: r of its splats; reach_m: the
    largest distance of a keyframe from the submap's origin.
    """

    index: int
    descriptors: Descriptors
    opacity_ratio: float = 1.0
    reach_m: float = 0.0


@dataclass(eq=False)
class DescribedSubmaps(Records[SubmapDescriptor]):
    """Descriptors of S submaps, in the order in which their loops were searched.

    rows [K, D]: of all keyframes, submap by submap; facts [S, 4]: number of the submap, opacity_ratio, reach_m, and
    the end of its rows.
    """

    rows: Column = field(default_factory=lambda: Column.of(np.float32, 0))
    facts: Column = field(default_factory=lambda: Column.of(np.float64, 4))

    @staticmethod
    def of(known: Iterable[SubmapDescriptor]) -> "DescribedSubmaps":
        """Return the descriptors of submaps in their order."""
        if isinstance(known, DescribedSubmaps):
            return known
        made = DescribedSubmaps()
        for submap in known:
            made.append(submap)
        return made

    def append(self, submap: SubmapDescriptor) -> None:
        """Append a submap. All have descriptors of the same length."""
        if not len(self.rows) and len(submap.descriptors):  # now their length is known
            folder, self.rows = self.rows.folder, Column.of(np.float32, submap.descriptors.shape[1])
            self.rows.folder = folder
        if len(submap.descriptors):
            self.rows.extend(submap.descriptors)
        self.facts.append([submap.index, submap.opacity_ratio, submap.reach_m, len(self.rows)])

    def __len__(self) -> int:
        return len(self.facts)

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Return the number of each submap [S]."""
        return self.facts.used[:, 0].astype(np.int64)

    @property
    def opacity_ratio(self) -> Matrix:
        """Return r of the splats of each submap [S]."""
        return self.facts.used[:, 1].copy()

    @property
    def reach_m(self) -> Matrix:
        """Return the largest distance of a keyframe from the origin of each submap [S], metres."""
        return self.facts.used[:, 2].copy()

    @property
    def counts(self) -> NDArray[np.int64]:
        """Return the number of keyframes of each submap [S]."""
        ends = np.concatenate([[0], self.facts.used[:, 3]]).astype(np.int64)
        return np.asarray(ends[1:] - ends[:-1])

    def _record(self, i: int) -> SubmapDescriptor:
        index, ratio, reach_m, end = self.facts.used[i].tolist()
        first = int(self.facts.used[i - 1, 3]) if i else 0
        return SubmapDescriptor(int(index), self.rows.used[first : int(end)], ratio, reach_m)
