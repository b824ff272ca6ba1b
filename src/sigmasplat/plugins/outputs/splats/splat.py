"""Read and write splats as `.splat`, a simple format of web viewers: 32 bytes per splat, no header.

Three float32 of position (metres), three of scale (metres, not logarithms), one byte each of red, green, blue and
opacity (0 to 255), one byte each of the unit quaternion wxyz (128 = 0, ±128 = ±1). The splats that cover most come
first, so that viewers show an image before the download is complete. Colours are clipped to [0, 1]. The format cannot
hold harmonics or σ². Layout: antimatter15/splat, convert.py and main.js.

Such a file can be recognised only by its length and by its unit quaternions, which other data rarely contain.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import (
    GaussianField,
    SourceError,
    SplatValues,
    log_scales_of,
    opacities_of,
    opacity_bytes,
    open_binary,
    replacing,
    to_bytes,
    unit,
)

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 3), ("opacity", "u1"), ("quat", "u1", 4)])
UNIT = (0.9, 1.1)
"""Range of the norm of a unit quaternion after rounding to bytes, with a margin for other writers' rounding."""


def write_field(path: Path, field: GaussianField) -> None:
    """Write the splats atomically. Raises RunError if the file cannot be written."""
    values = SplatValues.of(field)
    cover = values.log_scales.sum(1) + np.log(np.maximum(values.opacities, np.finfo(np.float64).tiny))
    values = values.ordered(np.argsort(-cover, kind="stable"))
    rows = np.empty(len(values), ROW)
    rows["mean"] = values.means
    rows["scale"] = np.exp(values.log_scales)
    rows["color"] = to_bytes(values.colors * 255.0)
    rows["opacity"] = opacity_bytes(values.opacities)
    rows["quat"] = to_bytes(values.quats * 128.0 + 128.0)
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(rows.tobytes())


def read_field(path: Path) -> GaussianField:
    """Read a .splat file; σ² becomes exp(−7).

    Raises SourceError if it is missing, empty, if its length is not a multiple of 32, or if a splat is not valid.
    """
    with open_binary(path, "cannot read map") as file:
        data = file.read()
    if not data or len(data) % ROW.itemsize:
        what = f"{len(data)} bytes are not a multiple of {ROW.itemsize}" if data else "it is empty"
        raise SourceError(f"{path} is not a .splat file, or is truncated: {what}")
    rows = np.frombuffer(data, ROW)
    quats = (rows["quat"] - 128.0) / 128.0
    _check(rows, np.linalg.norm(quats, axis=1), path)
    return SplatValues(
        rows["mean"].astype(np.float64),
        unit(quats),
        log_scales_of(rows["scale"].astype(np.float64)),
        opacities_of(rows["opacity"]),
        rows["color"] / 255.0,
        np.empty((len(rows), 0)),
    ).field(path)


def _check(rows: NDArray[np.void], norms: NDArray[np.float64], path: Path) -> None:
    finite = np.isfinite(rows["mean"]).all(1) & np.isfinite(rows["scale"]).all(1) & (rows["scale"] >= 0.0).all(1)
    bad = np.flatnonzero(~(finite & (norms > UNIT[0]) & (norms < UNIT[1])))
    if len(bad):
        raise SourceError(
            f"{path} is not a .splat file, or is damaged: splat {bad[0]} has no valid position, scale and rotation "
            f"({len(bad)} of {len(rows)} splats are invalid)"
        )
