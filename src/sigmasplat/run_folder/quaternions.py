"""Normalise quaternions and pack them by their three smallest components."""

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]


def unit(quats: Doubles) -> Doubles:
    """Return quaternions [N, 4] scaled to length 1."""
    lengths: Doubles = np.linalg.norm(quats, axis=1, keepdims=True)
    return quats / lengths


def smallest_three(quats: Doubles) -> tuple[NDArray[np.intp], Doubles]:
    """Split unit quaternions [N, 4] into the index of the largest component [N] and the other three [N, 3], in order.

    Signs are chosen so that the largest component is positive. It then follows from the others, which are within ±1/√2.
    """
    which = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    positive = quats * np.where(quats[rows, which] < 0.0, -1.0, 1.0)[:, None]
    return which, positive[np.arange(4) != which[:, None]].reshape(-1, 3)


def from_smallest_three(which: NDArray[np.intp], others: Doubles) -> Doubles:
    """Return unit quaternions [N, 4] from the result of `smallest_three`."""
    quats: Doubles = np.empty((len(which), 4))
    quats[np.arange(4) != which[:, None]] = others.ravel()
    quats[np.arange(len(which)), which] = np.sqrt(np.maximum(1.0 - (others**2).sum(1), 0.0))
    return unit(quats)
