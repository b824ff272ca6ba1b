"""Poses in columns: of submaps, of their keyframes, and the places of frames relative to keyframes."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.column import Column, Records
from sigmasplat.types import Matrix


def _of_poses() -> Column:
    return Column.of(np.float64, 4, 4)


@dataclass(eq=False)
class Poses(Records[Matrix]):
    """A list of poses [4, 4]; those that are read are copies. rows [N, 4, 4]."""

    rows: Column = field(default_factory=_of_poses)

    def __setitem__(self, i: int, pose: Matrix) -> None:
        self.rows.used[range(len(self))[i]] = pose

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.rows.used, dtype)

    def append(self, pose: Matrix) -> None:
        """Append a pose."""
        self.rows.append(pose)

    def copied(self) -> "Poses":
        """Return the same poses in other memory."""
        return Poses(Column(self.rows.used.copy(), len(self)))

    def _record(self, i: int) -> Matrix:
        return np.array(self.rows.values[i])


@dataclass(eq=False)
class KeyframePoses(Sequence[Sequence[Matrix]]):
    """T_submap_camera [4, 4] of the keyframes of each submap. Those of the last submap may change; the others are
    final.

    rows [K, 4, 4]: those of all submaps but the last; ends [S - 1]: number of keyframes up to the end of each of these
    submaps; newest: those of the last submap, None before the first one.
    """

    rows: Column = field(default_factory=_of_poses)
    ends: Column = field(default_factory=lambda: Column.of(np.int64))
    newest: list[Matrix] | None = None

    def __len__(self) -> int:
        return len(self.ends) + (self.newest is not None)

    @overload
    def __getitem__(self, i: int) -> Sequence[Matrix]: ...
    @overload
    def __getitem__(self, i: slice) -> Sequence[Sequence[Matrix]]: ...
    def __getitem__(self, i: int | slice) -> Sequence[Matrix] | Sequence[Sequence[Matrix]]:
        known = range(len(self))
        return [self._of(s) for s in known[i]] if isinstance(i, slice) else self._of(known[i])

    def _of(self, submap: int) -> Sequence[Matrix]:
        if submap == len(self.ends):
            return self.last
        first = int(self.ends.values[submap - 1]) if submap else 0
        return list(self.rows.used[first : int(self.ends.values[submap])].copy())

    @property
    def last(self) -> list[Matrix]:
        """Return the poses of the last submap's keyframes; a change of this list changes them."""
        return [] if self.newest is None else self.newest

    @property
    def counts(self) -> NDArray[np.int64]:
        """Return the number of keyframes of each submap [S]."""
        newest = [] if self.newest is None else [len(self.newest)]
        return np.concatenate([np.diff(self.ends.used, prepend=0), np.array(newest, np.int64)])

    @property
    def total(self) -> int:
        """Return the number of keyframes."""
        return len(self.rows) + len(self.last)

    def stacked(self) -> Matrix:
        """Return the poses of all keyframes [K, 4, 4], submap by submap."""
        return np.concatenate([self.rows.used, np.array(self.last, np.float64).reshape(-1, 4, 4)])

    def begin(self, poses: list[Matrix]) -> None:
        """Begin the next submap, with poses of its first keyframes; those of the submap before are final."""
        if self.newest is not None:
            self.rows.extend(np.array(self.newest, np.float64).reshape(-1, 4, 4))
            self.ends.append(len(self.rows))
        self.newest = poses

    def copied(self) -> "KeyframePoses":
        """Return the same poses; those of the last submap may then change here only."""
        rows, ends = (column.first(len(column)) for column in (self.rows, self.ends))
        return KeyframePoses(rows, ends, None if self.newest is None else list(self.newest))


NUMBERS = 2
"""Columns before the pose: submap and keyframe, which are exact as floating-point numbers."""


class Place(NamedTuple):
    """The pose of a frame relative to a keyframe of a submap; both numbers count from 0."""

    submap: int
    keyframe: int
    T_keyframe_camera: Matrix


@dataclass(eq=False)
class Places(Records[Place]):
    """The places of all frames. rows [F, 18]: submap, keyframe, and T_keyframe_camera [4, 4] by rows."""

    rows: Column = field(default_factory=lambda: Column.of(np.float64, NUMBERS + 16))

    @staticmethod
    def of(known: Iterable[Place]) -> "Places":
        """Return places in their order."""
        places = Places()
        for place in known:
            places.append(place)
        return places

    @property
    def submap(self) -> NDArray[np.int64]:
        """Return the submap of each frame [F]."""
        return self.rows.used[:, 0].astype(np.int64)

    @property
    def keyframe(self) -> NDArray[np.int64]:
        """Return the keyframe of each frame in its submap [F]."""
        return self.rows.used[:, 1].astype(np.int64)

    @property
    def T_keyframe_camera(self) -> Matrix:
        """Return the pose of each frame relative to its keyframe [F, 4, 4]."""
        return self.rows.used[:, NUMBERS:].reshape(-1, 4, 4).copy()

    def append(self, place: Place) -> None:
        """Append the place of the next frame."""
        self.rows.append([place.submap, place.keyframe, *place.T_keyframe_camera.ravel()])

    def first(self, count: int) -> "Places":
        """Return the places of the first frames, in the same memory."""
        return Places(self.rows.first(count))

    def _record(self, i: int) -> Place:
        row = self.rows.used[i]
        return Place(int(row[0]), int(row[1]), row[NUMBERS:].reshape(4, 4).copy())
