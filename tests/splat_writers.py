"""Write formats that the package only reads, as samples for the tests of the readers: SPZ 4, .gltf."""

import base64
import gzip
import json
import struct
from pathlib import Path

import zstandard

from sigmasplat.data.field import GaussianField
from sigmasplat.data.harmonics import count
from sigmasplat.plugins.outputs.splats import gltf, spz


def write_spz4(path: Path, field: GaussianField) -> None:
    """Write the streams of SPZ 3 behind the header and the table of version 4."""
    spz.write_field(path, field)
    data = gzip.decompress(path.read_bytes())
    _, _, size, degree, bits = struct.unpack_from("<4sIIBB", data)
    streams, at = [], 16
    for width in (9, 1, 3, 3, 4, 3 * count(degree)):
        streams.append(data[at : at + size * width])
        at += size * width
    plain = [stream for stream in streams if stream]
    packed = [zstandard.ZstdCompressor(write_checksum=True).compress(stream) for stream in plain]
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, size, degree, bits, 0, len(plain), 32)
    table = [struct.pack("<QQ", len(small), len(large)) for small, large in zip(packed, plain, strict=True)]
    path.write_bytes(b"".join([header, *table, *packed]))


def write_gltf(path: Path, field: GaussianField) -> None:
    """Write a GLB's document as JSON, with its data in a URI."""
    gltf.write_field(path, field)
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    uri = base64.b64encode(data[28 + length :]).decode()
    document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{uri}"
    path.write_text(json.dumps(document))
