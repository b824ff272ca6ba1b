"""Values of all frames in one array: a list of objects takes several times the memory."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

GROWTH = 1.25
"""Factor by which the space grows when it is full."""
FEWEST = 64


@dataclass(eq=False)
class Column:
    """One value per frame, a number or an array, appended one by one. values [space, …]: the first `count` are used.

    Raises ValueError if `values` has fewer.
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
