"""Where each frame is: the submap, the keyframe, and the pose relative to it."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.column import Column, Records
from sigmasplat.types import Matrix

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

    POSE_COLUMNS: ClassVar[slice] = slice(NUMBERS, NUMBERS + 16)
    """The columns of `rows` that hold a pose."""

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
