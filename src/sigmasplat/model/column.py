"""Values of all frames or keyframes in one array: a list of objects takes several times the memory."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

Record = TypeVar("Record")
GROWTH = 1.25
"""Factor by which the space grows when it is full."""
FEWEST = 64


@dataclass(eq=False)
class Column:
    """One value per frame or keyframe, a number or an array, appended one by one.

    values [space, …]: the first `count` are used. Raises ValueError if `values` has fewer.
    """

    values: NDArray[Any] = field(default_factory=lambda: np.zeros(0))
    count: int = 0

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
            space = max(FEWEST, int(GROWTH * self.count) + 1)
            grown = np.zeros((space, *self.values.shape[1:]), self.values.dtype)
            grown[: self.count] = self.used
            self.values = grown
        self.values[self.count] = value
        self.count += 1

    def first(self, count: int) -> "Column":
        """Return the first values, in the same memory."""
        return Column(self.values[: min(count, self.count)], min(count, self.count))


@dataclass(eq=False)
class Records(Sequence[Record], Generic[Record]):
    """A sequence of records that are made from the rows of a column on reading."""

    rows: Column

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, i: int) -> Record: ...
    @overload
    def __getitem__(self, i: slice) -> list[Record]: ...
    def __getitem__(self, i: int | slice) -> Record | list[Record]:
        known = range(len(self))
        return [self._record(k) for k in known[i]] if isinstance(i, slice) else self._record(known[i])

    @abstractmethod
    def _record(self, i: int) -> Record:
        """Return a record by its number, which exists."""
