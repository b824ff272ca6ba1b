"""Read and write splats as Niantic's SPZ: 19 or 20 bytes per splat before compression; web, game and phone viewers.

Each kind of value is one stream for all splats: positions (24-bit fixed point), opacities (0 to 255), colours
(f_dc · 0.15 + ½, 0 to 255), log scales (steps of 1/16 from −10), rotations, harmonics (steps of 1/128, 128 is 0).
Rotations in version 2: one byte each of x, y, z, while w ≥ 0 follows from them; in versions 3 and 4: 2 bits for the
index of the largest of x, y, z, w, then sign and 9 bits of each other one. Versions 2 and 3 are compressed with gzip,
version 4 with Zstandard (`spz_container`).
Axes are x right, y up, z back: the writer rotates maps by 180° about x, the reader rotates them back. Splats are in
Morton order, because similar neighbours compress better. The format cannot hold σ². Layout:
nianticlabs/spz, README.md and load-spz.cc.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.field import GaussianField
from sigmasplat.errors import ConfigError, RunError
from sigmasplat.files.atomic import replacing
from sigmasplat.files.reading import open_binary
from sigmasplat.plugins.outputs.splats.spz_container import VERSIONS, SpzHeader, pack, unpack
from sigmasplat.run_folder.quaternions import Doubles, from_smallest_three, smallest_three, unit
from sigmasplat.run_folder.splat_values import SH_C0, SplatValues, morton_order, opacities_of, opacity_bytes

DEFAULT_VERSION = 3
"""Most current readers accept it: nianticlabs/spz, splat-transform, three.js, Spark, Babylon.js."""
FRACTIONAL_BITS = 12
"""Positions have steps of a quarter of a millimetre up to 2 km from the origin; larger maps have coarser steps."""
LARGEST_FIXED = (1 << 23) - 1
COLOR_SCALE = 0.15
LOG_SCALE_START, LOG_SCALE_STEPS = -10.0, 16.0
MAGNITUDES = (1 << 9) - 1


def write_field(path: Path, field: GaussianField, *, version: int = DEFAULT_VERSION) -> None:
    """Write the splats atomically as SPZ of version 2, 3 or 4.

    Raises ConfigError on another version, RunError if the file cannot be written or a position is too large.
    """
    if version not in VERSIONS:
        raise ConfigError(f"SPZ has versions 2, 3 and 4, found {version}")
    values = SplatValues.of(field).turned_about_x()
    values = values.ordered(morton_order(values.means))
    bits = _fractional_bits(path, values.means)
    colors = (values.colors - 0.5) / SH_C0 * COLOR_SCALE + 0.5
    streams = [
        np.round(values.means * 2.0**bits).astype("<i4")[..., None].view("u1")[..., :3].tobytes(),
        opacity_bytes(values.opacities).tobytes(),
        _bytes(colors * 255.0),
        _bytes((values.log_scales - LOG_SCALE_START) * LOG_SCALE_STEPS),
        _three_bytes(values.quats) if version == 2 else _packed_rotations(values.quats).tobytes(),
        _bytes(np.round(values.harmonics * 128.0) + 128.0),
    ]
    data = pack(SpzHeader(version, len(values), values.degree, bits), streams)
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(data)


def read_field(path: Path) -> GaussianField:
    """Read an SPZ file of version 2, 3 or 4; σ² becomes exp(−7). Extensions are skipped.

    Raises SourceError if it is missing, damaged, truncated, of an unsupported version or degree, or not SPZ.
    """
    with open_binary(path, "cannot read map") as file:
        header, streams = unpack(file, path)
    positions, opacities, colors, scales, rotations, harmonics = (
        np.frombuffer(stream, "u1").reshape(header.size, width)
        for stream, width in zip(streams, header.widths, strict=True)
    )
    values = SplatValues(
        _fixed(positions) / 2.0**header.fractional_bits,
        _first_three(rotations) if header.version == 2 else _smallest_three(rotations),
        scales / LOG_SCALE_STEPS + LOG_SCALE_START,
        opacities_of(opacities[:, 0]),
        (colors / 255.0 - 0.5) / COLOR_SCALE * SH_C0 + 0.5,
        (harmonics - 128.0) / 128.0,
    )
    return values.turned_about_x().field(path)


def _fractional_bits(path: Path, means: Doubles) -> int:
    """Return the number of fractional bits of the 24-bit positions: fewer than the default if positions are large.
    Raises RunError if even none are too many."""
    farthest = float(np.abs(means).max(initial=0.0))
    if not farthest <= LARGEST_FIXED:
        raise RunError(
            f"{path} cannot be written: a splat is {farthest:.3g} m from the origin, SPZ holds at most "
            f"{LARGEST_FIXED / 1000:.0f} km; the map is damaged, make it again"
        )
    if farthest * 2.0**FRACTIONAL_BITS <= LARGEST_FIXED:
        return FRACTIONAL_BITS
    return max(0, int(np.floor(np.log2(LARGEST_FIXED / farthest))))


def _bytes(values: Doubles) -> bytes:
    return np.clip(np.round(values), 0.0, 255.0).astype(np.uint8).tobytes()


def _fixed(positions: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Convert signed 24-bit integers, lowest byte first [N, 9], to int32 [N, 3]."""
    low, middle, high = (positions[:, i::3].astype(np.int32) for i in range(3))
    return low | middle << 8 | (high ^ 128) - 128 << 16


def _three_bytes(quats: Doubles) -> bytes:
    """Pack unit quaternions wxyz [N, 4] into the x, y, z of version 2, with the sign that makes w positive."""
    xyz = quats[:, 1:] * np.where(quats[:, :1] < 0.0, -1.0, 1.0)
    return _bytes((xyz + 1.0) * 127.5)


def _packed_rotations(quats: Doubles) -> NDArray[np.uint32]:
    """Pack unit quaternions wxyz [N, 4] into words [N] of versions 3 and 4."""
    which, others = smallest_three(np.roll(quats, -1, axis=1))
    word = which.astype("<u4")
    for part in others.T:
        magnitude = np.round(np.abs(part) / np.sqrt(0.5) * MAGNITUDES).astype(np.uint32)
        word = word << 10 | (part < 0.0).astype(np.uint32) << 9 | np.minimum(magnitude, MAGNITUDES)
    return word.astype("<u4")


def _smallest_three(rotations: NDArray[np.uint8]) -> Doubles:
    """Unpack the rotations of versions 3 and 4, bytes [N, 4], to unit quaternions wxyz [N, 4]."""
    word = np.ascontiguousarray(rotations).view("<u4")[:, 0]
    others = np.empty((len(word), 3))
    for column in (2, 1, 0):
        sign = 1.0 - 2.0 * (word >> 9 & 1)
        others[:, column] = sign * (word & MAGNITUDES) / MAGNITUDES * np.sqrt(0.5)
        word = word >> 10
    return np.roll(from_smallest_three(word.astype(np.intp), others), 1, axis=1)


def _first_three(rotations: NDArray[np.uint8]) -> Doubles:
    """Unpack the rotations of version 2, bytes [N, 3], to unit quaternions wxyz [N, 4]."""
    xyz = rotations / 127.5 - 1.0
    w = np.sqrt(np.maximum(1.0 - (xyz**2).sum(1), 0.0))
    return unit(np.column_stack([w, xyz]))
