"""The container of SPZ files: a header and one stream of bytes for each kind of value.

Versions 2 and 3: one gzip stream of a header of 16 bytes, then the streams one after the other. Version 4: a header of
32 bytes without compression, then possibly extensions, then a table of 16 bytes per stream (compressed and plain size),
then the streams, each compressed with Zstandard. Streams without bytes are not stored in version 4. Layout:
nianticlabs/spz, README.md.
"""

import gzip
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import zstandard

from sigmasplat.data.harmonics import DEGREES, count
from sigmasplat.errors import SourceError
from sigmasplat.run_folder.splat_values import check_count

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b\x08"
VERSIONS = (2, 3, 4)
HEADER = struct.Struct("<4sIIBBBB")
HEADER_OF_4 = struct.Struct("<4sIIBBBBI12x")
STREAM = struct.Struct("<QQ")
ZSTANDARD_LEVEL = 19
MAX_RATIO = 1032
"""Maximum compression ratio of Deflate. Zstandard has none; nianticlabs/spz refuses more than 1024 in version 4."""
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
                "save it as version 2 to 4 with degree 0 to 3, or as PLY"
            )
        check_count(self.size, packed_size, path)
        needed = self.size * sum(self.widths)
        if needed > packed_size * MAX_RATIO:
            raise SourceError(f"{path} is truncated: its header says {self.size} splats = {needed} bytes")


def pack(header: SpzHeader, streams: Sequence[bytes]) -> bytes:
    """Return the bytes of a file with this header and these six streams."""
    values = (MAGIC, header.version, header.size, header.degree, header.fractional_bits, 0)
    if header.version < 4:
        return gzip.compress(b"".join([HEADER.pack(*values, 0), *streams]), compresslevel=9, mtime=0)
    stored = [stream for stream in streams if stream]
    packer = zstandard.ZstdCompressor(level=ZSTANDARD_LEVEL, write_checksum=True)
    packed = [packer.compress(stream) for stream in stored]
    table = [STREAM.pack(len(small), len(large)) for small, large in zip(packed, stored, strict=True)]
    return b"".join([HEADER_OF_4.pack(*values, len(stored), HEADER_OF_4.size), *table, *packed])


def unpack(file: BinaryIO, path: Path) -> tuple[SpzHeader, list[bytes]]:
    """Read the header and the six streams. Raises SourceError if the file is damaged, truncated, or not SPZ."""
    start = file.read(len(MAGIC))
    file.seek(0)
    if start == MAGIC:
        return _unpack_zstandard(file, path)
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


def _unpack_zstandard(file: BinaryIO, path: Path) -> tuple[SpzHeader, list[bytes]]:
    data = file.read(HEADER_OF_4.size)
    if len(data) < HEADER_OF_4.size:
        raise SourceError(f"{path} is truncated: its header of {HEADER_OF_4.size} bytes is incomplete")
    _, version, size, degree, bits, _flags, given, table_at = HEADER_OF_4.unpack(data)
    header = SpzHeader(version, size, degree, bits)
    header.check(path, path.stat().st_size)
    sizes = [size * width for width in header.widths]
    stored = [plain for plain in sizes if plain]
    file.seek(table_at)
    table = file.read(STREAM.size * given)
    entries = list(STREAM.iter_unpack(table)) if len(table) == STREAM.size * given else []
    if table_at < HEADER_OF_4.size or [plain for _, plain in entries if plain] != stored:
        raise SourceError(f"{path} is damaged or truncated: its table of streams does not match {size} splats")
    found = iter([_decompress(file, small, plain, path) for small, plain in entries if plain])
    return header, [next(found) if plain else b"" for plain in sizes]


def _decompress(file: BinaryIO, packed_size: int, size: int, path: Path) -> bytes:
    """Read one stream of version 4. Raises SourceError unless it has exactly `size` bytes."""
    packed = file.read(min(packed_size, path.stat().st_size))
    try:
        if zstandard.frame_content_size(packed) in (-1, size):
            stream = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
            if len(packed) == packed_size and len(stream) == size:
                return stream
    except zstandard.ZstdError as problem:
        raise SourceError(f"{path} is damaged or truncated: {problem}; copy or download it again") from problem
    raise SourceError(f"{path} is damaged or truncated: a stream does not have {size} bytes; copy or download it again")
