"""Write formats that the package only reads, as samples for the tests of the readers: compressed PLY, SPZ 4, .gltf."""

import base64
import gzip
import json
import struct
from pathlib import Path

import numpy as np
import zstandard
from numpy.typing import NDArray

from sigmasplat.data.field import GaussianField
from sigmasplat.data.harmonics import count
from sigmasplat.files.ply_elements import header_of
from sigmasplat.plugins.outputs.splats import gltf, spz
from sigmasplat.plugins.outputs.splats.compressed_ply import (
    CHUNK,
    COLOR_BITS,
    LIMITS,
    REST,
    ROTATION_BITS,
    SH_RANGE,
    WORDS,
    XYZ_BITS,
)
from sigmasplat.run_folder.splat_values import (
    Doubles,
    SplatValues,
    by_channel,
    morton_order,
    opacity_bytes,
    smallest_three,
)

LOG_SCALE_LIMIT = 20.0


def write_compressed_ply(path: Path, field: GaussianField) -> None:
    """Write the splats."""
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
    parts = header_of(*elements), np.concatenate(limits, axis=1).astype("<f4").tobytes(), words.tobytes(), sh.tobytes()
    path.write_bytes(b"".join(parts))


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
