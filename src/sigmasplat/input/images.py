"""Read colour and depth images; every problem becomes a SourceError that names the file."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.frame_arrays import depth_from_integers
from sigmasplat.errors import SourceError
from sigmasplat.files.pictures import npy_shape, open_image, read_npy


def read_color(path: Path) -> NDArray[np.uint8]:
    """Read an image as 8-bit RGB [H, W, 3]. Raises SourceError naming a missing, truncated or damaged file."""
    _refuse_missing(path)
    with open_image(path) as image:
        return np.asarray(image.convert("RGB"))


def decode_color(path: Path, data: bytes) -> NDArray[np.uint8]:
    """Decode an image in memory as 8-bit RGB [H, W, 3]; `path` names it. Raises SourceError if it is damaged."""
    with open_image(path, data) as image:
        return np.asarray(image.convert("RGB"))


def read_values(path: Path, data: bytes | None = None) -> NDArray[Any]:
    """Decode an image file, or `data` of one, without converting its values. Raises SourceError if it is damaged."""
    with open_image(path, data) as image:
        return np.asarray(image)


def image_size(path: Path, data: bytes | None = None) -> tuple[int, int]:
    """Return (width, height) in pixels from the header of a file, or of `data`. Raises SourceError if it is not an
    image."""
    if data is None:
        _refuse_missing(path)
        if path.suffix == ".npy":
            height, width = npy_shape(path)[:2]
            return width, height
    with open_image(path, data) as image:
        return image.size


def read_depth(path: Path, units_per_metre: float) -> NDArray[np.float32]:
    """Read depth along the optical axis as float32 metres [H, W], 0 = no reading.

    Whole numbers (16-bit PNG, integer .npy) are divided by `units_per_metre`; floats (.tiff, .npy) are in metres.
    Raises SourceError if the file is unreadable, not a single-channel depth image, negative, or holds NaN or inf.
    """
    _refuse_missing(path)
    raw = read_npy(path) if path.suffix == ".npy" else read_values(path)
    return depth_to_metres(path, raw, units_per_metre)


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


def _refuse_missing(path: Path) -> None:
    if not path.is_file():
        raise SourceError(f"{path}: the image is missing; download it again or remove it from the list")
