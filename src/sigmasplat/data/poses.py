"""Values of all frames or keyframes in one array, because a list of objects takes several times the memory: poses of
submaps and of their keyframes, places of frames relative to keyframes.
"""

import mmap
import os
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, ClassVar, Generic, NamedTuple, Self, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from sigmasplat.types import Matrix

Record = TypeVar("Record")
Number = TypeVar("Number", bound=np.generic)
GROWTH = 1.25
"""Factor by which the space grows when it is full."""
FEWEST = 64
LEAST_ON_DISK, STEP_BYTES = 2**18, 2**20
"""A column with fewer bytes stays in RAM; a file grows by the second, or by an eighth."""


@dataclass(eq=False)
class Column:
    """One value per frame, keyframe or submap, a number or an array, appended one by one.

    values [space, …]: the first `count` are used. Raises ValueError if `values` has fewer. folder: where a long column
    may move to a file, so that RAM does not grow with it; None = it stays in RAM. The file has no name, so it is gone
    when the process ends, however it ends.
    """

    values: NDArray[Any] = field(default_factory=lambda: np.zeros(0))
    count: int = 0
    folder: Path | None = field(default=None, init=False)
    _file: Any = field(default=None, init=False, repr=False)
    _map: mmap.mmap | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        if not 0 <= self.count <= len(self.values):
            raise ValueError(f"a column of {len(self.values)} values cannot hold {self.count}")

    @staticmethod
    def of(dtype: Any, *shape: int) -> "Column":
        """Return an empty column of values with a type and a shape."""
        return Column(np.zeros((0, *shape), dtype))

    def __len__(self) -> int:
        return self.count

    @property
    def used(self) -> NDArray[Any]:
        """Return a view of the values [count, …]."""
        return self.values[: self.count]

    def append(self, value: Any) -> None:
        """Append a value. Arrays that `used` returned before stay as they were."""
        if self.count == len(self.values):
            self._reserve(self.count + 1)
        self.values[self.count] = value
        self.count += 1

    def extend(self, values: NDArray[Any]) -> None:
        """Append values [n, …]."""
        end = self.count + len(values)
        if end > len(self.values):
            self._reserve(end)
        self.values[self.count : end] = values
        self.count = end

    def release(self) -> None:
        """Give the RAM of a column on disk back to the system, after much of it was read."""
        if self._map is not None:
            with suppress(OSError):
                self._map.madvise(mmap.MADV_DONTNEED)

    def _reserve(self, least: int) -> None:
        """Make space for at least so many values: on disk for a long column that may move there, if there is room."""
        row_bytes = self.values.itemsize * int(np.prod(self.values.shape[1:]))
        if self.folder is not None and least * row_bytes > LEAST_ON_DISK and hasattr(os, "posix_fallocate"):
            try:
                self._move(least * row_bytes, row_bytes, self.folder)
                return
            except OSError:  # no space left, or a file system that cannot do this
                self.folder = self._file = self._map = None
        space = max(FEWEST, least, int(GROWTH * self.count) + 1)
        grown = np.zeros((space, *self.values.shape[1:]), self.values.dtype)
        grown[: self.count] = self.used
        self.values = grown

    def _move(self, size: int, row_bytes: int, folder: Path) -> None:
        """Reserve at least so many bytes in the file: a disk that is full when memory is written would end the process.
        Values in RAM are copied to it the first time; earlier maps of it stay valid."""
        before, reserved = (None, len(self._map)) if self._map else (self.used, 0)
        if self._file is None:
            existing = next(path for path in (folder, *folder.absolute().parents) if path.is_dir())
            self._file = TemporaryFile(dir=existing, buffering=0)  # noqa: SIM115 - it lives as long as this object
        size = -(-max(size, reserved + reserved // 8) // STEP_BYTES) * STEP_BYTES
        os.posix_fallocate(self._file.fileno(), 0, size)
        self._map = mmap.mmap(self._file.fileno(), size)
        space = size // row_bytes
        flat = np.frombuffer(self._map, self.values.dtype, space * (row_bytes // self.values.itemsize))
        self.values = flat.reshape(space, *self.values.shape[1:])
        if before is not None:
            self.values[: self.count] = before

    def first(self, count: int) -> "Column":
        """Return the first values, in the same memory."""
        return Column(self.values[: min(count, self.count)], min(count, self.count))


class Part(Generic[Number]):
    """One value of each record, a number or an array of a shape: some columns of `Records.rows`. As an attribute of the
    records it is a copy of all values [N, …]."""

    def __init__(self, kind: type[Number], *shape: int) -> None:
        self.kind, self.shape, self.columns = kind, shape, slice(0)

    def __set_name__(self, records: "type[Records[Any]]", name: str) -> None:
        width = records.width + int(np.prod(self.shape))
        self.columns, records.width, records.parts = slice(records.width, width), width, (*records.parts, self)

    def __get__(self, records: "Records[Any]", kind: type) -> NDArray[Number]:
        return self._shaped(records.rows.used[:, self.columns], -1)

    def of(self, row: NDArray[Any]) -> Any:
        """Return the value in a row, a number or an array."""
        value = self._shaped(row[self.columns])
        return value if self.shape else value.item()

    def _shaped(self, values: NDArray[Any], *before: int) -> NDArray[Number]:
        return values.reshape((*before, *self.shape)).astype(self.kind)


@dataclass(eq=False)
class Records(Sequence[Record], Generic[Record]):
    """A sequence of records that are made from the rows of a column on reading. rows [N, width]: the parts of a record
    side by side, if the class names its parts."""

    width: ClassVar[int] = 0
    parts: ClassVar[tuple[Part[Any], ...]] = ()

    rows: Column = field(default_factory=Column)

    def __post_init__(self) -> None:
        if self.parts and self.rows.values.ndim == 1:
            self.rows = Column.of(np.float64, self.width)

    @classmethod
    def joined(cls, *values: NDArray[Any]) -> Self:
        """Return records of the values of their parts, [N, …] each."""
        rows = np.concatenate([part.reshape(len(part), -1) for part in values], 1)
        return cls(Column(rows, len(rows)))

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Record]:
        return (self._record(i) for i in range(len(self)))

    @overload
    def __getitem__(self, i: int) -> Record: ...
    @overload
    def __getitem__(self, i: slice) -> list[Record]: ...
    def __getitem__(self, i: int | slice) -> Record | list[Record]:
        known = range(len(self))
        return [self._record(k) for k in known[i]] if isinstance(i, slice) else self._record(known[i])

    def add(self, *values: Any) -> None:
        """Append a record: the values of its parts."""
        self.rows.append(self.row_of(*values))

    @staticmethod
    def row_of(*values: Any) -> NDArray[Any]:
        """Return the row of a record, given the values of its parts."""
        return np.concatenate([np.ravel(value) for value in values])

    def values(self, i: int) -> list[Any]:
        """Return the values of the parts of a record."""
        return [part.of(self.rows.used[i]) for part in self.parts]

    @abstractmethod
    def _record(self, i: int) -> Record:
        """Return a record by its number, which exists."""


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
class KeyframePoses(Records[Sequence[Matrix]]):
    """T_submap_camera [4, 4] of the keyframes of each submap. Only those of the last submap may change.

    rows [K, 4, 4]: those of all submaps but the last; ends [S - 1]: number of keyframes up to the end of each of these
    submaps; newest: those of the last submap, None before the first one.
    """

    rows: Column = field(default_factory=_of_poses)
    ends: Column = field(default_factory=lambda: Column.of(np.int64))
    newest: list[Matrix] | None = None

    def __len__(self) -> int:
        return len(self.ends) + (self.newest is not None)

    def _record(self, i: int) -> Sequence[Matrix]:
        if i == len(self.ends):
            return self.last
        first = int(self.ends.values[i - 1]) if i else 0
        return list(self.rows.used[first : int(self.ends.values[i])].copy())

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


class Place(NamedTuple):
    """The pose of a frame relative to a keyframe of a submap; both numbers count from 0."""

    submap: int
    keyframe: int
    T_keyframe_camera: Matrix


@dataclass(eq=False)
class Places(Records[Place]):
    """The places of all frames."""

    submap = Part(np.int64)
    keyframe = Part(np.int64)
    T_keyframe_camera = Part(np.float64, 4, 4)

    def append(self, place: Place) -> None:
        """Append the place of the next frame."""
        self.add(*place)

    def first(self, count: int) -> "Places":
        """Return the places of the first frames, in the same memory."""
        return Places(self.rows.first(count))

    def _record(self, i: int) -> Place:
        return Place(*self.values(i))
