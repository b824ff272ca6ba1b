"""Read splats from Niantic's SPZ, versions 2 and 3, and write version 3: 20 bytes per splat before compression.

Most current readers accept version 3: nianticlabs/spz, splat-transform, three.js, Spark, Babylon.js.

Each kind of value is one stream for all splats: positions (24-bit fixed point), opacities (0 to 255), colours (f_dc ·
0.15 + ½, 0 to 255), log scales (steps of 1/16 from −10), rotations, harmonics (steps of 1/128, 128 is 0). Rotations in
version 2: one byte each of x, y, z, while w ≥ 0 follows from them; in versions 3 and 4: 2 bits for the index of the
largest of x, y, z, w, then sign and 9 bits of each other one. Versions 2 and 3 are one gzip stream of a header of 16
bytes, then the streams one after the other. Version 4 is a header of 32 bytes, then possibly extensions, a table of 16
bytes per stream (compressed and plain size), then the streams that have bytes, each compressed with Zstandard. Axes are
x right, y up, z back: the writer rotates maps by 180° about x, the reader rotates them back. Splats are in Morton
order, because similar neighbours compress better. The format cannot hold σ². Layout: nianticlabs/spz, README.md and
load-spz.cc.
"""

import gzip
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import (
    DEGREES,
    SH_C0,
    Doubles,
    GaussianField,
    RunError,
    SourceError,
    SplatValues,
    check_count,
    count,
    from_smallest_three,
    morton_order,
    opacities_of,
    opacity_bytes,
    open_binary,
    replacing,
    smallest_three,
    to_bytes,
    unit,
)

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b\x08"
VERSIONS = (2, 3)
HEADER = struct.Struct("<4sIIBBBB")
MAX_RATIO = 1032
"""Maximum compression ratio of Deflate."""
MAX_EXTENSION_BYTES = 1 << 20
"""Maximum number of bytes read after the splats, where a file may have extensions."""


@dataclass(frozen=True)
class SpzHeader:
    """Version, number of splats, degree of the harmonics, and fractional bits of the positions."""

    version: int
    size: int
    degree: int
    fractional_bits: int

    @property
    def widths(self) -> list[int]:
        """Return the number of bytes of a splat's position, opacity, colour, scale, rotation and harmonics."""
        return [9, 1, 3, 3, 3 if self.version == 2 else 4, 3 * count(self.degree)]

    def check(self, path: Path, packed_size: int) -> None:
        """Raise SourceError if the version or degree is unknown, or if so many splats do not fit into the file."""
        if self.version not in VERSIONS or self.degree > DEGREES:
            raise SourceError(
                f"{path} is SPZ version {self.version} with harmonics of degree {self.degree}; "
                "save it as version 3 with degree 0 to 3, or as PLY"
            )
        check_count(self.size, packed_size, path)
        needed = self.size * sum(self.widths)
        if needed > packed_size * MAX_RATIO:
            raise SourceError(f"{path} is truncated: its header says {self.size} splats = {needed} bytes")


def unpack(file: BinaryIO, path: Path) -> tuple[SpzHeader, list[bytes]]:
    """Read the header and the six streams. Raises SourceError if the file is damaged, truncated, or not SPZ 2 or 3."""
    start = file.read(len(MAGIC))
    file.seek(0)
    if start == MAGIC:
        raise SourceError(f"{path} is SPZ of version 4, which is not read; save it as version 3, or as PLY")
    try:
        return _unpack_gzip(file, path)
    except (EOFError, gzip.BadGzipFile, zlib.error) as problem:
        raise SourceError(f"{path} is damaged or truncated: {problem}; copy or download it again") from problem


def _unpack_gzip(file: BinaryIO, path: Path) -> tuple[SpzHeader, list[bytes]]:
    stream = gzip.GzipFile(fileobj=file)
    data = stream.read(HEADER.size)
    if len(data) < HEADER.size or not data.startswith(MAGIC):
        raise SourceError(f"{path} is not an SPZ file: its unzipped content does not start with NGSP")
    header = SpzHeader(*HEADER.unpack(data)[1:5])
    header.check(path, path.stat().st_size)
    needed = header.size * sum(header.widths)
    body = stream.read(needed)
    stream.read(MAX_EXTENSION_BYTES)  # to the end of the stream, where gzip compares the checksum
    if len(body) < needed:
        raise SourceError(
            f"{path} is truncated: its header says {header.size} splats = {needed} bytes, found {len(body)}"
        )
    streams = []
    for width in header.widths:
        streams.append(body[: header.size * width])
        body = body[header.size * width :]
    return header, streams


WRITTEN_VERSION = 3
FRACTIONAL_BITS = 12
"""Positions have steps of a quarter of a millimetre up to 2 km from the origin; larger maps have coarser steps."""
LARGEST_FIXED = (1 << 23) - 1
COLOR_SCALE = 0.15
LOG_SCALE_START, LOG_SCALE_STEPS = -10.0, 16.0
MAGNITUDES = (1 << 9) - 1


def write_field(path: Path, field: GaussianField) -> None:
    """Write the splats atomically. Raises RunError if the file cannot be written or a position is too large."""
    values = SplatValues.of(field).turned_about_x()
    values = values.ordered(morton_order(values.means))
    bits = _fractional_bits(path, values.means)
    colors = (values.colors - 0.5) / SH_C0 * COLOR_SCALE + 0.5
    streams = [
        np.round(values.means * 2.0**bits).astype("<i4")[..., None].view("u1")[..., :3].tobytes(),
        opacity_bytes(values.opacities).tobytes(),
        to_bytes(colors * 255.0).tobytes(),
        to_bytes((values.log_scales - LOG_SCALE_START) * LOG_SCALE_STEPS).tobytes(),
        _packed_rotations(values.quats).tobytes(),
        to_bytes(np.round(values.harmonics * 128.0) + 128.0).tobytes(),
    ]
    header = HEADER.pack(MAGIC, WRITTEN_VERSION, len(values), values.degree, bits, 0, 0)
    with replacing(path) as temporary:
        temporary.write_bytes(gzip.compress(b"".join([header, *streams]), compresslevel=9, mtime=0))


def read_field(path: Path) -> GaussianField:
    """Read an SPZ file of version 2 or 3; σ² becomes exp(−7). Extensions are skipped.

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


def _fixed(positions: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Convert signed 24-bit integers, lowest byte first [N, 9], to int32 [N, 3]."""
    low, middle, high = (positions[:, i::3].astype(np.int32) for i in range(3))
    return low | middle << 8 | (high ^ 128) - 128 << 16


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
