"""Quantise values to codebooks with k-means: numbers to 256 levels, rows of numbers to a palette. Deterministic."""

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import vq

from sigmasplat.run_folder.quaternions import Doubles

LEVELS = 256
LEVEL_STEPS, PALETTE_STEPS = 40, 6
"""Steps of Lloyd's algorithm."""


def levels(values: Doubles) -> tuple[Doubles, NDArray[np.uint8]]:
    """Return 256 ascending levels and the index of the nearest one for each value, in the shape of `values`.

    Lloyd's algorithm in one dimension: a level is the mean of the values between the middles to its neighbours. It
    starts from levels that share the cube root of the density of the values, which is optimal for many levels.
    """
    if not values.size:
        return np.zeros(LEVELS), np.zeros(values.shape, np.uint8)
    ordered = np.sort(values, axis=None)
    sums = np.concatenate([[0.0], np.cumsum(ordered - ordered[0])])
    book = _first_levels(ordered)
    for _ in range(LEVEL_STEPS):
        edges = np.concatenate([[0], np.searchsorted(ordered, (book[1:] + book[:-1]) / 2.0), [len(ordered)]])
        counts = np.diff(edges)
        means = np.diff(sums[edges]) / np.maximum(counts, 1) + ordered[0]
        book = np.sort(np.where(counts > 0, means, book))
    nearest = np.searchsorted((book[1:] + book[:-1]) / 2.0, values)
    return book, nearest.astype(np.uint8)


def _first_levels(ordered: Doubles) -> Doubles:
    """Return levels that are dense where the sorted values are: the density to the power of one third."""
    counts, edges = np.histogram(ordered, bins=4 * LEVELS)
    shares = np.concatenate([[0.0], np.cumsum(np.cbrt(counts))])
    book: Doubles = np.interp((np.arange(LEVELS) + 0.5) / LEVELS * shares[-1], shares, edges)
    return book


def palette(rows: Doubles, size: int) -> tuple[Doubles, NDArray[np.intp]]:
    """Return up to `size` rows that stand for all rows [N, k], and the index of the nearest one for each row [N].

    Lloyd's algorithm from rows at equal distances in the given order. Rows without a member keep their values.
    """
    book = rows[np.linspace(0, len(rows) - 1, min(size, len(rows))).round().astype(np.intp)]
    labels, _ = vq(rows, book)
    for _ in range(PALETTE_STEPS):
        members = np.bincount(labels, minlength=len(book))
        sums = np.stack([np.bincount(labels, rows[:, i], len(book)) for i in range(rows.shape[1])], axis=1)
        book = np.where(members[:, None] > 0, sums / np.maximum(members, 1)[:, None], book)
        labels, _ = vq(rows, book)
    return book, labels.astype(np.intp)
