"""Apply colour maps to arrays: viridis and inferno, interpolated from a few control points."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Rgb = NDArray[np.uint8]
Values = NDArray[np.floating[Any]]

# Equally spaced samples of matplotlib's colour maps (CC0); brightness rises evenly from end to end.
VIRIDIS = np.array(
    [(68, 1, 84), (71, 44, 122), (59, 81, 139), (44, 113, 142), (33, 144, 141), (39, 173, 129), (92, 200, 99),
     (170, 220, 50), (253, 231, 37)], np.float64,
)  # fmt: skip
INFERNO = np.array(
    [(0, 0, 4), (31, 12, 72), (85, 15, 109), (136, 34, 106), (186, 54, 85), (227, 89, 51), (249, 140, 10),
     (249, 201, 50), (252, 255, 164)], np.float64,
)  # fmt: skip

NO_READING = (38, 42, 48)
"""Slate grey: in neither colour map, so a hole cannot be mistaken for a value."""


def apply(values: Values, low: float, high: float, palette: NDArray[np.float64] = VIRIDIS) -> Rgb:
    """Map values of any shape from [low, high] to a palette [K, 3]: uint8 [..., 3]. Values outside are clipped."""
    span = high - low if high > low else 1.0
    position = np.clip((values.astype(np.float64) - low) / span, 0.0, 1.0) * (len(palette) - 1)
    stops = np.arange(len(palette))
    channels = [np.interp(position, stops, palette[:, c]) for c in range(3)]
    return np.stack(channels, -1).round().astype(np.uint8)


def apply_masked(
    values: Values, valid: NDArray[np.bool_], low: float, high: float, palette: NDArray[np.float64]
) -> Rgb:
    """Colour an array [H, W], with `NO_READING` where it is not valid."""
    out = apply(values, low, high, palette)
    out[~valid] = NO_READING
    return out


def value_range(values: Values, valid: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the 1st and the 99th percentile of the valid values; (0, 1) if no value is valid."""
    if not valid.any():
        return 0.0, 1.0
    low, high = np.percentile(values[valid], (1.0, 99.0))
    return float(low), float(high)


def from_zero(values: Values, valid: NDArray[np.bool_]) -> tuple[float, float]:
    """Return 0 and the 99th percentile of the valid values; (0, 1) if no value is valid."""
    return 0.0, value_range(values, valid)[1]
