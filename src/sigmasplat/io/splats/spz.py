"""Read and write splats as Niantic's SPZ: 19 or 20 bytes per splat before gzip; web, game and phone viewers read it.

A gzip stream. Header of 16 bytes: magic NGSP, version, number of splats, degree of the harmonics, fractional bits of
positions, flags, 0. Then each kind of value for all splats: positions (24-bit fixed point), opacities (0 to 255),
colours (f_dc · 0.15 + ½, 0 to 255), log scales (steps of 1/16 from −10), rotations, harmonics (steps of 1/128, 128 is
0). Rotations in version 2: one byte each of x, y, z, while w ≥ 0 follows from them; in version 3: 2 bits for the index
of the largest of x, y, z, w, then sign and 9 bits of each other one. Version 4 is not a gzip stream and cannot be read.
Axes are x right, y up, z back: the writer rotates maps by 180° about x, the reader rotates them back. Splats are in
Morton order, because gzip compresses similar neighbours better. The format cannot hold σ² and correlations. Layout:
nianticlabs/spz, README.md and load-spz.cc.
"""

import gzip
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.errors import SourceError
from sigmasplat.io.atomic import replacing
from sigmasplat.io.binary import open_binary
from sigmasplat.io.splats.quaternions import Doubles, from_smallest_three, smallest_three, unit
from sigmasplat.io.splats.values import SH_C0, SplatValues, morton_order, opacities_of, opacity_bytes
from sigmasplat.model.field import ATTRIBUTES, GaussianField
from sigmasplat.model.harmonics import DEGREES, count, turned

MAGIC = b"NGSP"
HEADER = struct.Struct("<4sIIBBBB")
WRITTEN, READ = 3, (2, 3)
"""The version that is written, and those that can be read."""
FRACTIONAL_BITS = 12
"""Positions have steps of a quarter of a millimetre up to 2 km from the origin; larger maps have coarser steps."""
LARGEST_FIXED = (1 << 23) - 1
COLOR_SCALE = 0.15
LOG_SCALE_START, LOG_SCALE_STEPS = -10.0, 16.0
MAGNITUDES = (1 << 9) - 1
DEFLATE_RATIO = 1032
"""Maximum compression ratio of Deflate."""
MAX_EXTENSION_BYTES = 1 << 20
"""Maximum number of bytes read after the splats, where a file may have extensions."""
R_RUB_RDF = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""Rotates our axes to the format's; it is its own inverse."""


def write_field(path: Path, field: GaussianField) -> None:
    """Write the splats atomically. Raises RunError if the file cannot be written."""
    values = _rotated(SplatValues.of(field))
    values = values.ordered(morton_order(values.means))
    bits = _fractional_bits(values.means)
    colors = (values.colors - 0.5) / SH_C0 * COLOR_SCALE + 0.5
    parts = [
        HEADER.pack(MAGIC, WRITTEN, len(values), values.degree, bits, 0, 0),
        np.round(values.means * 2.0**bits).astype("<i4")[..., None].view("u1")[..., :3].tobytes(),
        opacity_bytes(values.opacities).tobytes(),
        _bytes(colors * 255.0),
        _bytes((values.log_scales - LOG_SCALE_START) * LOG_SCALE_STEPS),
        _packed_rotations(values.quats).tobytes(),
        _bytes(np.round(values.harmonics * 128.0) + 128.0),
    ]
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(gzip.compress(b"".join(parts), compresslevel=9, mtime=0))


def read_field(path: Path) -> GaussianField:
    """Read an SPZ file of version 2 or 3; σ² becomes exp(−7). Extensions after the splats are skipped.

    Raises SourceError if it is missing, damaged, truncated, of an unsupported version or degree, or not SPZ.
    """
    with open_binary(path, "cannot read map") as file:
        version, size, degree, bits, body = _unzipped(file, path)
    widths = _widths(version, degree)
    parts = np.split(np.frombuffer(body, "u1"), np.cumsum([size * width for width in widths])[:-1])
    positions, opacities, colors, scales, rotations, harmonics = (
        part.reshape(size, width) for part, width in zip(parts, widths, strict=True)
    )
    values = SplatValues(
        _fixed(positions) / 2.0**bits,
        _smallest_three(rotations) if version == 3 else _first_three(rotations),
        scales / LOG_SCALE_STEPS + LOG_SCALE_START,
        opacities_of(opacities[:, 0]),
        (colors / 255.0 - 0.5) / COLOR_SCALE * SH_C0 + 0.5,
        (harmonics - 128.0) / 128.0,
    )
    return _rotated(values).field(path)


def _rotated(values: SplatValues) -> SplatValues:
    """Rotate a map by 180° about x, which is its own inverse; only signs of means, quaternions and harmonics change."""
    xyz = R_RUB_RDF.diagonal().numpy()
    ones = torch.ones(1, ATTRIBUTES["harmonics"], dtype=torch.float64)
    signs = turned(ones, R_RUB_RDF).round().numpy()[:, : values.harmonics.shape[1]]
    quats = values.quats * np.array([1.0, *xyz])
    return replace(values, means=values.means * xyz, quats=quats, harmonics=values.harmonics * signs)


def _widths(version: int, degree: int) -> list[int]:
    """Return the number of bytes of a splat's position, opacity, colour, scale, rotation and harmonics."""
    return [9, 1, 3, 3, 4 if version == 3 else 3, 3 * count(degree)]


def _unzipped(file: BinaryIO, path: Path) -> tuple[int, int, int, int, bytes]:
    """Return version, number of splats, degree, fractional bits, and the data after the header. Raises SourceError."""
    packed_size = path.stat().st_size
    try:
        stream = gzip.GzipFile(fileobj=file)
        header = stream.read(HEADER.size)
        if len(header) < HEADER.size or not header.startswith(MAGIC):
            raise SourceError(f"{path} is not an SPZ file: its unzipped content does not start with NGSP")
        _, version, size, degree, bits, _flags, _ = HEADER.unpack(header)
        if version not in READ or degree > DEGREES:
            raise SourceError(
                f"{path} is SPZ version {version} with harmonics of degree {degree}; "
                "save it as version 2 or 3 with degree 0 to 3, or as PLY"
            )
        needed = size * sum(_widths(version, degree))
        body = stream.read(needed) if needed <= packed_size * DEFLATE_RATIO else b""
        stream.read(MAX_EXTENSION_BYTES)  # to the end of the stream, where gzip compares the checksum
    except (EOFError, gzip.BadGzipFile, zlib.error) as problem:
        raise SourceError(f"{path} is damaged or truncated: {problem}; copy or download it again") from problem
    if len(body) < needed:
        raise SourceError(f"{path} is truncated: its header says {size} splats = {needed} bytes, found {len(body)}")
    return version, size, degree, bits, body


def _fractional_bits(means: Doubles) -> int:
    """Return the number of fractional bits of the 24-bit positions: fewer than the default if positions are large."""
    farthest = float(np.abs(means).max(initial=0.0))
    fitting = int(np.floor(np.log2(LARGEST_FIXED / farthest))) if farthest else FRACTIONAL_BITS
    return max(0, min(FRACTIONAL_BITS, fitting))


def _bytes(values: Doubles) -> bytes:
    return np.clip(np.round(values), 0.0, 255.0).astype(np.uint8).tobytes()


def _fixed(positions: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Convert signed 24-bit integers, lowest byte first [N, 9], to int32 [N, 3]."""
    low, middle, high = (positions[:, i::3].astype(np.int32) for i in range(3))
    return low | middle << 8 | (high ^ 128) - 128 << 16


def _packed_rotations(quats: Doubles) -> NDArray[np.uint32]:
    """Pack unit quaternions wxyz [N, 4] into words [N] of version 3."""
    which, others = smallest_three(np.roll(quats, -1, axis=1))
    word = which.astype("<u4")
    for part in others.T:
        magnitude = np.round(np.abs(part) / np.sqrt(0.5) * MAGNITUDES).astype(np.uint32)
        word = word << 10 | (part < 0.0).astype(np.uint32) << 9 | np.minimum(magnitude, MAGNITUDES)
    return word.astype("<u4")


def _smallest_three(rotations: NDArray[np.uint8]) -> Doubles:
    """Unpack the rotations of version 3, bytes [N, 4], to unit quaternions wxyz [N, 4]."""
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
