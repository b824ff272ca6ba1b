"""Read and write splats as SuperSplat's compressed PLY: 16 bytes per splat, and 72 bytes per chunk of 256 splats.

Elements: `chunk`, minimum and maximum of positions, log scales and colours of 256 splats; `vertex`, four words with a
splat's values relative to these limits; `sh`, only for view-dependent colours, one byte for each of f_rest_0…, in the
order of 3DGS's PLY. Bits from the highest: packed_position and packed_scale 11, 10, 11; packed_rotation 2 for the index
of the largest of w, x, y, z and 10 for each other one; packed_color 8 each for red, green, blue and opacity, which is
stored directly. Chunks of early files have no colour limits; they are 0 and 1. Splats are in Morton order, so that
chunks are small. The format cannot hold σ². Layout: PlayCanvas's splat-transform,
write-compressed-ply.ts, compressed-chunk.ts and decompress-ply.ts.
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
    by_channel,
    from_smallest_three,
    header_of,
    morton_order,
    opacities_of,
    opacity_bytes,
    open_binary,
    read_header,
    replacing,
    smallest_three,
)

CHUNK = 256
LIMITS = [f"{end}_{name}" for group in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
          for end in ("min", "max") for name in group]  # fmt: skip
WITHOUT_COLORS = LIMITS[:12]
WORDS = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
REST, HARMONICS = "f_rest_", (9, 24, 45)
LOG_SCALE_LIMIT = 20.0
SH_RANGE = 8.0
"""The byte of a harmonic covers −4 to 4."""
XYZ_BITS, ROTATION_BITS, COLOR_BITS = (11, 10, 11), (10, 10, 10), (8, 8, 8)


def write_field(path: Path, field: GaussianField) -> None:
    """Write the splats atomically. Raises RunError if the file cannot be written."""
    values = SplatValues.of(field)
    values = values.ordered(morton_order(values.means))
    log_scales = np.clip(values.log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
    limits, words = [], np.empty((len(values), 4), "<u4")
    for column, part, bits in ((0, values.means, XYZ_BITS), (2, log_scales, XYZ_BITS), (3, values.colors, COLOR_BITS)):
        low, high = _ranges(part)
        limits += [low, high]
        words[:, column] = _packed(_within(part, low, high), bits)
    which, others = smallest_three(values.quats)
    words[:, 1] = which << 30 | _packed(others * np.sqrt(0.5) + 0.5, ROTATION_BITS)
    words[:, 3] = words[:, 3] << 8 | opacity_bytes(values.opacities)
    sh = by_channel(np.clip((values.harmonics / SH_RANGE + 0.5) * 256.0, 0.0, 255.0).astype(np.uint8))
    elements: list[tuple[str, int, list[str]]] = [
        ("chunk", -(-len(values) // CHUNK), [f"float {name}" for name in LIMITS]),
        ("vertex", len(values), [f"uint {name}" for name in WORDS]),
    ]
    if sh.shape[1]:
        elements.append(("sh", len(values), [f"uchar {REST}{i}" for i in range(sh.shape[1])]))
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(header_of(*elements))
        file.write(np.concatenate(limits, axis=1).astype("<f4").tobytes())
        file.write(words.tobytes())
        file.write(sh.tobytes())


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


def _ranges(part: Doubles) -> tuple[Doubles, Doubles]:
    """Return the minima and maxima [C, 3] of each chunk, rounded to float32 as in the file."""
    chunks = range(0, len(part), CHUNK)
    low, high = (np.array([f(part[i : i + CHUNK], axis=0) for i in chunks]).reshape(-1, 3) for f in (np.min, np.max))
    return low.astype(np.float32).astype(np.float64), high.astype(np.float32).astype(np.float64)


def _within(part: Doubles, low: Doubles, high: Doubles) -> Doubles:
    """Return each value relative to its chunk's limits, in [0, 1]; 0 if the limits are equal."""
    low, span = (np.repeat(values, CHUNK, axis=0)[: len(part)] for values in (low, high - low))
    return (part - low) / np.where(span > 0.0, span, 1.0)


def _packed(part: Doubles, bits: tuple[int, int, int]) -> NDArray[np.uint32]:
    """Pack three numbers in [0, 1] into one word [N], the first one in the highest bits."""
    word = np.zeros(len(part), np.uint32)
    for column, width in enumerate(bits):
        steps = (1 << width) - 1
        word = word << np.uint32(width) | np.clip(np.round(part[:, column] * steps), 0, steps).astype(np.uint32)
    return word


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
