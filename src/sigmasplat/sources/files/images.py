"""Read colour and depth images; every problem becomes a SourceError that names the file."""

import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.errors import SourceError
from sigmasplat.model.frame_arrays import depth_from_integers

Value = TypeVar("Value")


def read_color(path: Path) -> NDArray[np.uint8]:
    """Read an image as 8-bit RGB [H, W, 3]. Raises SourceError naming a missing, truncated or damaged file."""
    return _guard_reading(path, lambda: _decode(path, "RGB"))


def decode_color(path: Path, data: bytes) -> NDArray[np.uint8]:
    """Decode an image in memory as 8-bit RGB [H, W, 3]; `path` names it. Raises SourceError if it is damaged."""
    return guard_decoding(path, lambda: np.asarray(Image.open(io.BytesIO(data)).convert("RGB")))


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) in pixels from the file header. Raises SourceError if the file is not an image."""
    if path.suffix == ".npy":
        height, width = _guard_reading(path, lambda: np.load(path, mmap_mode="r").shape[:2])
        return int(width), int(height)
    return _guard_reading(path, lambda: _header_size(path))


def read_depth(path: Path, units_per_metre: float) -> NDArray[np.float32]:
    """Read depth along the optical axis as float32 metres [H, W], 0 = no reading.

    Whole numbers (16-bit PNG, integer .npy) are divided by `units_per_metre`; floats (.tiff, .npy) are in metres.
    Raises SourceError if the file is unreadable, not a single-channel depth image, negative, or holds NaN or inf.
    """
    return depth_to_metres(
        path, _guard_reading(path, lambda: np.load(path) if path.suffix == ".npy" else _decode(path)), units_per_metre
    )


def depth_to_metres(path: Path, raw: NDArray[Any], units_per_metre: float) -> NDArray[np.float32]:
    """Convert a stored depth image to float32 metres, as `read_depth` does; `path` names it. Raises SourceError."""
    if raw.ndim != 2 or raw.dtype == np.uint8 or raw.dtype.kind not in "iuf":
        raise SourceError(
            f"{path}: not a depth image (found {raw.dtype} {raw.shape}); expected 16-bit PNG or float metres"
        )
    if raw.dtype.kind == "f":
        return _checked_metres(path, raw.astype(np.float32))
    return _checked_metres(path, depth_from_integers(raw, units_per_metre))


def _checked_metres(path: Path, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    bad = int((~np.isfinite(depth_m)).sum())
    if bad:
        raise SourceError(f"{path}: depth holds {bad} NaN or inf pixels; write 0 where there is no reading")
    if float(depth_m.min(initial=0.0)) < 0.0:
        raise SourceError(f"{path}: depth is negative ({depth_m.min():.3f} m); write 0 where there is no reading")
    return depth_m


def _decode(path: Path, mode: str | None = None) -> NDArray[Any]:
    with Image.open(path) as image:
        return np.asarray(image if mode is None else image.convert(mode))


def _header_size(path: Path) -> tuple[int, int]:
    with Image.open(path) as image:
        return image.size


def _guard_reading(path: Path, read: Callable[[], Value]) -> Value:
    """Call a reader of a file. Raises SourceError if the file is missing or unreadable."""
    if not path.is_file():
        raise SourceError(f"{path}: the image is missing; download it again or remove it from the list")
    return guard_decoding(path, read)


def guard_decoding(path: Path, read: Callable[[], Value]) -> Value:
    """Call a decoder. Raises SourceError naming `path` for any of the exceptions that damaged data can cause."""
    try:
        return read()
    except (OSError, ValueError, SyntaxError, EOFError, IndexError, KeyError, TypeError, struct.error) as error:
        raise SourceError(f"{path}: unreadable image ({error}); download or copy it again") from error
    except Image.DecompressionBombError as error:
        raise SourceError(f"{path}: unreadable image ({error})") from error
