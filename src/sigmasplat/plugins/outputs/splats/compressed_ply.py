"""Read splats from SuperSplat's compressed PLY: 16 bytes per splat, and 72 bytes per chunk of 256 splats.

Elements: `chunk`, minimum and maximum of positions, log scales and colours of 256 splats; `vertex`, four words with a
splat's values relative to these limits; `sh`, only for view-dependent colours, one byte for each of f_rest_0…, in the
order of 3DGS's PLY. Bits from the highest: packed_position and packed_scale 11, 10, 11; packed_rotation 2 for the index
of the largest of w, x, y, z and 10 for each other one; packed_color 8 each for red, green, blue and opacity, which is
stored directly. Chunks of early files have no colour limits; they are 0 and 1. The format cannot hold σ². Layout:
PlayCanvas's splat-transform, write-compressed-ply.ts, compressed-chunk.ts and decompress-ply.ts. It is not
written: SOG is smaller, and the same programs read it.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import (
    Doubles,
    Element,
    GaussianField,
    SourceError,
    SplatValues,
    from_smallest_three,
    opacities_of,
    open_binary,
    read_header,
)

CHUNK = 256
LIMITS = [f"{end}_{name}" for group in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
          for end in ("min", "max") for name in group]  # fmt: skip
WITHOUT_COLORS = LIMITS[:12]
WORDS = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
REST, HARMONICS = "f_rest_", (9, 24, 45)
SH_RANGE = 8.0
"""The byte of a harmonic covers −4 to 4."""
XYZ_BITS, ROTATION_BITS, COLOR_BITS = (11, 10, 11), (10, 10, 10), (8, 8, 8)


def read_field(path: Path) -> GaussianField:
    """Read a compressed PLY; σ² becomes exp(−7).

    Raises SourceError if it is missing, truncated, not a compressed PLY of splats, or has nan or inf.
    """
    with open_binary(path, "cannot read map") as file:
        elements = read_header(file, path)
        _check(elements, path)
        chunks, splats, *rest = (element.read(file, path) for element in elements)
    low, high = _limits(chunks, len(splats), path)
    position, rotation, scale, color = (splats[name].astype(np.uint32) for name in WORDS)
    parts = [_unpacked(position, XYZ_BITS), _unpacked(scale, XYZ_BITS), _unpacked(color >> np.uint32(8), COLOR_BITS)]
    means, log_scales, colors = (low[i] * (1.0 - part) + high[i] * part for i, part in enumerate(parts))
    others = (_unpacked(rotation, ROTATION_BITS) - 0.5) / np.sqrt(0.5)
    quats = from_smallest_three((rotation >> 30).astype(np.intp), others)
    opacities = opacities_of((color & 255).astype(np.uint8))
    return SplatValues(means, quats, log_scales, opacities, colors, _harmonics(rest, len(splats))).field(path)


def is_compressed(elements: list[Element]) -> bool:
    """Return whether a PLY with these elements is a compressed one."""
    return bool(elements) and elements[0].name == "chunk"


def _unpacked(word: NDArray[np.uint32], bits: tuple[int, int, int]) -> Doubles:
    """Unpack three numbers in [0, 1] from each word: [N, 3]."""
    part = np.empty((len(word), 3))
    for column, width in reversed(list(enumerate(bits))):
        steps = (1 << width) - 1
        part[:, column] = (word & steps) / steps
        word = word >> np.uint32(width)
    return part


def _harmonics(rest: list[NDArray[np.void]], count: int) -> Doubles:
    """Return harmonics [N, 3·k], columns 3·i + channel: bytes decode to the middle of their step, 0 and 255 to ∓4."""
    if not rest:
        return np.empty((count, 0))
    each = len(rest[0].dtype.names or ()) // 3
    sh = np.stack([rest[0][f"{REST}{channel * each + i}"] for i in range(each) for channel in range(3)], axis=1)
    return (np.where(sh == 0, 0.0, np.where(sh == 255, 256.0, sh + 0.5)) / 256.0 - 0.5) * SH_RANGE


def _limits(chunks: NDArray[np.void], count: int, path: Path) -> tuple[Doubles, Doubles]:
    """Return the minima and maxima of position, log scale and colour of each splat's chunk, each [3, N, 3].

    Raises SourceError unless all are finite.
    """
    given = [chunks[name].astype(np.float64) for name in LIMITS if name in (chunks.dtype.names or ())]
    if len(given) < len(LIMITS):
        given[len(WITHOUT_COLORS) :] = [np.full(len(chunks), value) for value in (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)]
    table = np.stack(given, axis=1)
    if not np.isfinite(table).all():
        raise SourceError(f"{path} is damaged: the limits of a chunk have nan or inf")
    each = np.repeat(table, CHUNK, axis=0)[:count].reshape(count, 3, 2, 3)
    return each[:, :, 0].swapaxes(0, 1), each[:, :, 1].swapaxes(0, 1)


def _check(elements: list[Element], path: Path) -> None:
    """Raise SourceError unless the elements are those of a compressed PLY with one chunk per 256 splats."""
    names = [element.name for element in elements]
    if names not in (["chunk", "vertex"], ["chunk", "vertex", "sh"]):
        raise SourceError(
            f"{path} is not a compressed PLY of splats: it has {', '.join(names)}, not chunk, vertex, optionally sh"
        )
    for element, required in zip(elements, (WITHOUT_COLORS, WORDS, [f"{REST}0"]), strict=False):
        missing = [name for name in required if name not in (element.row_type(path).names or ())]
        if missing:
            raise SourceError(f"{path} is not a compressed PLY of splats: no column {missing[0]} in '{element.name}'")
    chunks, count = elements[0].count, elements[1].count
    if count < 0 or chunks != -(-count // CHUNK):
        raise SourceError(f"{path} is damaged: {chunks} chunks of {CHUNK} do not match {count} splats")
    for sh in elements[2:]:
        given = set(sh.row_type(path).names or ())
        if sh.count != count or len(given) not in HARMONICS or given != {f"{REST}{i}" for i in range(len(given))}:
            raise SourceError(f"{path} has {sh.count} × {len(given)} harmonics, expected {count} × 9, 24 or 45")
