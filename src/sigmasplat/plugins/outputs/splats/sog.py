"""Write splats as PlayCanvas's SOG, version 2: a zip of meta.json and lossless WebP images.

One pixel per splat, in the same order in all images; the splats are in Morton order, because similar neighbours
compress better. Images: means_l and means_u, the low and high bytes of positions (16 bits between `mins` and `maxs`, of
sign(x) · log(|x| + 1)); quats, the three smallest components (0 to 255 for ∓1/√2) and 252 + the index of the largest of
w, x, y, z; scales, an index into a codebook of log scales for each axis; sh0, an index into a codebook of f_dc for each
channel, and the opacity; for view-dependent colours shN_labels, the row of a palette of harmonics (low and high byte in
red and green), and shN_centroids, the palette: 64 rows per line, one pixel per harmonic, an index into a codebook for
each channel. Axes as in 3DGS's PLY. The format cannot hold σ². Layout: PlayCanvas's developer site,
"SOG format", and splat-transform, read-sog.ts.
"""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.cluster.vq import vq

from sigmasplat.api import (
    SH_C0,
    Doubles,
    GaussianField,
    SplatValues,
    count,
    morton_order,
    opacity_bytes,
    replacing,
    smallest_three,
    to_bytes,
)

LEVELS = 256
LEVEL_STEPS, PALETTE_STEPS = 40, 6
"""Steps of Lloyd's algorithm."""


def levels(values: Doubles) -> tuple[Doubles, NDArray[np.uint8]]:
    """Return 256 ascending levels and the index of the nearest one for each value, in the shape of `values`.

    Lloyd's algorithm in one dimension: a level is the mean of the values between the middles to its neighbours. It
    starts from levels that share the cube root of the density of the values, which is optimal for many levels.
    """
    if not values.size:
        return np.zeros(LEVELS), np.zeros(values.shape, np.uint8)
    ordered = np.sort(values, axis=None)
    sums = np.concatenate([[0.0], np.cumsum(ordered - ordered[0])])
    book = _first_levels(ordered)
    for _ in range(LEVEL_STEPS):
        edges = np.concatenate([[0], np.searchsorted(ordered, (book[1:] + book[:-1]) / 2.0), [len(ordered)]])
        counts = np.diff(edges)
        means = np.diff(sums[edges]) / np.maximum(counts, 1) + ordered[0]
        book = np.sort(np.where(counts > 0, means, book))
    nearest = np.searchsorted((book[1:] + book[:-1]) / 2.0, values)
    return book, nearest.astype(np.uint8)


def _first_levels(ordered: Doubles) -> Doubles:
    """Return levels that are dense where the sorted values are: the density to the power of one third."""
    counts, edges = np.histogram(ordered, bins=4 * LEVELS)
    shares = np.concatenate([[0.0], np.cumsum(np.cbrt(counts))])
    book: Doubles = np.interp((np.arange(LEVELS) + 0.5) / LEVELS * shares[-1], shares, edges)
    return book


def palette(rows: Doubles, size: int) -> tuple[Doubles, NDArray[np.intp]]:
    """Return up to `size` rows that stand for all rows [N, k], and the index of the nearest one for each row [N].

    Lloyd's algorithm from rows at equal distances in the given order. Rows without a member keep their values.
    """
    book = rows[np.linspace(0, len(rows) - 1, min(size, len(rows))).round().astype(np.intp)]
    labels, _ = vq(rows, book)
    for _ in range(PALETTE_STEPS):
        members = np.bincount(labels, minlength=len(book))
        sums = np.stack([np.bincount(labels, rows[:, i], len(book)) for i in range(rows.shape[1])], axis=1)
        book = np.where(members[:, None] > 0, sums / np.maximum(members, 1)[:, None], book)
        labels, _ = vq(rows, book)
    return book, labels.astype(np.intp)


MAGIC = b"PK\x03\x04"
FIRST_TAG = 252
PALETTE_ROWS, MAX_PALETTE = 64, 8192
STEPS = 65535.0
ZIP_TIME = (1980, 1, 1, 0, 0, 0)

Pixels = NDArray[np.uint8]


def write_field(path: Path, field: GaussianField) -> None:
    """Write the splats atomically. Raises RunError if the file cannot be written."""
    values = SplatValues.of(field)
    values = values.ordered(morton_order(values.means))
    which, others = smallest_three(values.quats)
    logs = np.sign(values.means) * np.log1p(np.abs(values.means))
    low, high = (f(logs, axis=0) if len(logs) else np.zeros(3) for f in (np.min, np.max))
    steps = np.round((logs - low) / np.where(high > low, high - low, 1.0) * STEPS).astype(np.uint16)
    scale_book, scales = levels(values.log_scales)
    color_book, colors = levels((values.colors - 0.5) / SH_C0)
    images = {
        "means_l.webp": _image(steps & 255),
        "means_u.webp": _image(steps >> 8),
        "scales.webp": _image(scales),
        "quats.webp": _image(to_bytes((others * np.sqrt(0.5) + 0.5) * 255.0), which + FIRST_TAG),
        "sh0.webp": _image(colors, opacity_bytes(values.opacities)),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "SigmaSplat"},
        "count": len(values),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book.tolist(), "files": ["sh0.webp"]},
    }
    if values.degree and len(values):
        meta["shN"], more = _packed_harmonics(values)
        images |= more
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, pixels in images.items():
            archive.writestr(zipfile.ZipInfo(name, ZIP_TIME), _webp(pixels))
        archive.writestr(zipfile.ZipInfo("meta.json", ZIP_TIME), json.dumps(meta), zipfile.ZIP_DEFLATED)


def _packed_harmonics(values: SplatValues) -> tuple[dict[str, Any], dict[str, Pixels]]:
    rows, labels = palette(values.harmonics, min(MAX_PALETTE, max(PALETTE_ROWS, len(values) // 4)))
    book, indices = levels(rows)
    each = count(values.degree)
    table = np.zeros((-(-len(rows) // PALETTE_ROWS) * PALETTE_ROWS, each, 3), np.uint8)
    table[: len(rows)] = indices.reshape(-1, each, 3)
    names = ["shN_centroids.webp", "shN_labels.webp"]
    meta = {"count": len(rows), "bands": values.degree, "codebook": book.tolist(), "files": names}
    bytes_of_labels = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1)
    images = (_opaque(table.reshape(-1, PALETTE_ROWS * each, 3)), _image(bytes_of_labels))
    return meta, dict(zip(names, images, strict=True))


def _image(values: NDArray[Any], alpha: NDArray[Any] | None = None) -> Pixels:
    """Return an image [rows, columns, 4] of values [N, 3] and alpha [N] (255 if not given), and 0 for empty pixels.

    Width and height are multiples of four.
    """
    width = 4 * max(1, int(np.ceil(np.sqrt(len(values)) / 4)))
    rows = 4 * max(1, -(-len(values) // (4 * width)))
    pixels = np.zeros((rows * width, 4), np.uint8)
    pixels[: len(values), :3] = values
    pixels[:, 3] = 255
    if alpha is not None:
        pixels[: len(values), 3] = alpha
    return pixels.reshape(rows, width, 4)


def _opaque(colors: Pixels) -> Pixels:
    return np.concatenate([colors, np.full((*colors.shape[:2], 1), 255, np.uint8)], axis=2)


def _webp(pixels: Pixels) -> bytes:
    """Encode an image without loss; `exact` also keeps the colours of transparent pixels."""
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "WEBP", lossless=True, exact=True, quality=75, method=4)
    return data.getvalue()
