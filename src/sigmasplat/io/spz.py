"""Read and write splats as Niantic's SPZ: 19 or 20 bytes each before gzip, read by web, game and phone viewers.

A gzip stream. Header of 16 bytes: magic NGSP, version, number of splats, degree of the harmonics, fractional bits of
positions, flags, 0. Then one kind of value after the other, for all splats: positions (24-bit fixed point), opacities
(255ths), colours (f_dc · 0.15 + ½ in 255ths), log scales (sixteenths from −10), rotations, harmonics (128ths from 128).
Rotations in version 2: x, y, z in a byte each, w ≥ 0 follows; in version 3: which of x, y, z, w is largest in 2 bits,
sign and 9 bits of each other one. Version 4 is no gzip stream and not read here. Axes are x right, y up, z back: the
writer turns maps by 180° about x, the reader turns them back. Splats lie in Morton order: gzip saves more where
neighbours are alike. σ² and correlations have no place in the format: they are lost. Layout: nianticlabs/spz, README.md
and load-spz.cc.
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
from sigmasplat.io.splat_values import (
    SH_C0,
    Doubles,
    SplatValues,
    from_smallest_three,
    morton_order,
    opacities_of,
    opacity_bytes,
    smallest_three,
    unit,
)
from sigmasplat.model.field import ATTRIBUTES, GaussianField
from sigmasplat.model.harmonics import DEGREES, count, turned

MAGIC = b"NGSP"
HEADER = struct.Struct("<4sIIBBBB")
WRITTEN, READ = 3, (2, 3)
"""Version written, versions read."""
FRACTIONAL_BITS = 12
"""Positions to a quarter of a millimetre, up to 2 km away; larger maps have coarser steps."""
LARGEST_FIXED = (1 << 23) - 1
COLOR_SCALE = 0.15
LOG_SCALE_START, LOG_SCALE_STEPS = -10.0, 16.0
MAGNITUDES = (1 << 9) - 1
DEFLATE_RATIO = 1032
"""Deflate makes nothing smaller than by this factor."""
MOST_BEHIND = 1 << 20
"""Bytes read behind the splats, where extensions lie."""
R_RUB_RDF = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""Takes our axes to the format's, and back."""


def write_field(path: Path, field: GaussianField) -> None:
    """Write the splats, in one step. Raises RunError if the place is not writable."""
    values = _turned(SplatValues.of(field))
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
    """Read an SPZ file of version 2 or 3; σ² becomes exp(−7). What follows the splats is passed over.

    Raises SourceError if it is missing, damaged, truncated, of another version or degree, or not SPZ.
    """
    try:
        with path.open("rb") as file:
            version, size, degree, bits, body = _unzipped(file, path)
    except OSError as problem:
        raise SourceError(f"cannot read map {path}: {problem.strerror or problem}") from problem
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
    return _turned(values).field(path)


def _turned(values: SplatValues) -> SplatValues:
    """Turn a map by 180° about x, there or back: of means, quaternions and harmonics only signs change."""
    xyz = R_RUB_RDF.diagonal().numpy()
    ones = torch.ones(1, ATTRIBUTES["harmonics"], dtype=torch.float64)
    signs = turned(ones, R_RUB_RDF).round().numpy()[:, : values.harmonics.shape[1]]
    quats = values.quats * np.array([1.0, *xyz])
    return replace(values, means=values.means * xyz, quats=quats, harmonics=values.harmonics * signs)


def _widths(version: int, degree: int) -> list[int]:
    """Return bytes of a splat's position, opacity, colour, scale, rotation and harmonics."""
    return [9, 1, 3, 3, 4 if version == 3 else 3, 3 * count(degree)]


def _unzipped(file: BinaryIO, path: Path) -> tuple[int, int, int, int, bytes]:
    """Return version, number of splats, degree, fractional bits, and what follows the header. Raises SourceError."""
    packed_size = path.stat().st_size
    try:
        stream = gzip.GzipFile(fileobj=file)
        header = stream.read(HEADER.size)
        if len(header) < HEADER.size or not header.startswith(MAGIC):
            raise SourceError(f"{path} is no SPZ file: what it holds, unzipped, does not begin with a header of NGSP")
        _, version, size, degree, bits, _flags, _ = HEADER.unpack(header)
        if version not in READ or degree > DEGREES:
            raise SourceError(
                f"{path} is SPZ version {version} with harmonics of degree {degree}; "
                "save it as version 2 or 3 with degree 0 to 3, or as PLY"
            )
        needed = size * sum(_widths(version, degree))
        body = stream.read(needed) if needed <= packed_size * DEFLATE_RATIO else b""
        stream.read(MOST_BEHIND)  # on to the end of the stream, whose checksum tells of damage
    except (EOFError, gzip.BadGzipFile, zlib.error) as problem:
        raise SourceError(f"{path} is damaged or truncated: {problem}; copy or download it again") from problem
    if len(body) < needed:
        raise SourceError(f"{path} is truncated: its header promises {size} splats = {needed} bytes, found {len(body)}")
    return version, size, degree, bits, body


def _fractional_bits(means: Doubles) -> int:
    """Return how many bits of 24 lie behind the point: fewer than usual where positions would not fit otherwise."""
    farthest = float(np.abs(means).max(initial=0.0))
    fitting = int(np.floor(np.log2(LARGEST_FIXED / farthest))) if farthest else FRACTIONAL_BITS
    return max(0, min(FRACTIONAL_BITS, fitting))


def _bytes(values: Doubles) -> bytes:
    return np.clip(np.round(values), 0.0, 255.0).astype(np.uint8).tobytes()


def _fixed(positions: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return 24-bit integers with a sign, lowest byte first [N, 9], as int32 [N, 3]."""
    low, middle, high = (positions[:, i::3].astype(np.int32) for i in range(3))
    return low | middle << 8 | (high ^ 128) - 128 << 16


def _packed_rotations(quats: Doubles) -> NDArray[np.uint32]:
    """Pack unit quaternions wxyz [N, 4] as version 3 does: words [N]."""
    which, others = smallest_three(np.roll(quats, -1, axis=1))
    word = which.astype("<u4")
    for part in others.T:
        magnitude = np.round(np.abs(part) / np.sqrt(0.5) * MAGNITUDES).astype(np.uint32)
        word = word << 10 | (part < 0.0).astype(np.uint32) << 9 | np.minimum(magnitude, MAGNITUDES)
    return word.astype("<u4")


def _smallest_three(rotations: NDArray[np.uint8]) -> Doubles:
    """Unpack the rotations of version 3 [N, 4]: unit quaternions wxyz [N, 4]."""
    word = np.ascontiguousarray(rotations).view("<u4")[:, 0]
    others = np.empty((len(word), 3))
    for column in (2, 1, 0):
        sign = 1.0 - 2.0 * (word >> 9 & 1)
        others[:, column] = sign * (word & MAGNITUDES) / MAGNITUDES * np.sqrt(0.5)
        word = word >> 10
    return np.roll(from_smallest_three(word.astype(np.intp), others), 1, axis=1)


def _first_three(rotations: NDArray[np.uint8]) -> Doubles:
    """Unpack the rotations of version 2 [N, 3]: unit quaternions wxyz [N, 4]."""
    xyz = rotations / 127.5 - 1.0
    w = np.sqrt(np.maximum(1.0 - (xyz**2).sum(1), 0.0))
    return unit(np.column_stack([w, xyz]))
