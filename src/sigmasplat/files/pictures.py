"""Decode images and arrays that users give: the format and the number of pixels are checked before decoding."""

import io
import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray
from PIL import Image, ImageFile, UnidentifiedImageError

from sigmasplat.env import import_optional
from sigmasplat.errors import SourceError
from sigmasplat.files.reading import guarded, open_regular, refuse_special

FORMATS = ("JPEG", "PNG", "BMP", "PPM", "TIFF", "WEBP")
"""Formats of images in recordings. Others are refused: Pillow gives EPS, for example, to Ghostscript, which runs it."""
MOST_PIXELS = 36_000_000
"""Largest image; 8K video has 33 megapixels. As float32 its colours take 0.4 GB."""
MOST_BYTES = 1 << 29
REMEDY = "download or copy it again"


@contextmanager
def open_image(path: Path, data: bytes | None = None) -> Iterator[ImageFile.ImageFile]:
    """Open an image file, or `data` of one that `path` names, and yield it before its pixels are decoded.

    Raises SourceError naming the file if it is not of `FORMATS`, has more than `MOST_PIXELS`, or cannot be decoded.
    """
    opened = open_regular(path, most=MOST_BYTES) if data is None else nullcontext(io.BytesIO(data))
    with opened as file, guarded(path, REMEDY, SourceError, "unreadable image"):
        try:
            image = Image.open(file, formats=FORMATS)
        except (Image.DecompressionBombError, UnidentifiedImageError) as problem:
            bomb = isinstance(problem, Image.DecompressionBombError)
            why = "too many pixels" if bomb else f"not {', '.join(FORMATS)}, or damaged"
            raise SourceError(f"{path}: unreadable image ({why}); {'reduce it' if bomb else REMEDY}") from problem
        with image:
            check_pixels(path, image.size)
            yield image


def check_pixels(path: Path, size: tuple[int, int]) -> None:
    """Raise SourceError if an image of `size` (width, height) has more than `MOST_PIXELS`."""
    if math.prod(size) > MOST_PIXELS:
        raise SourceError(
            f"{path}: unreadable image ({size[0]}×{size[1]} pixels, the limit is {MOST_PIXELS / 1e6:.0f} megapixels); "
            "reduce it"
        )


def read_npy(path: Path) -> NDArray[Any]:
    """Read a .npy file. Raises SourceError if it is not one, holds objects, or is shorter than its header says."""
    refuse_special(path, most=MOST_BYTES)  # then the file is mapped into memory, which refuses objects and short files
    with guarded(path, REMEDY, SourceError, "unreadable image"):
        values = npy.open_memmap(path, mode="r")
        if len(values.shape) not in (2, 3):
            raise ValueError(f"not a depth image: an array of {values.dtype} with shape {values.shape}")
    check_pixels(path, (values.shape[1], values.shape[0]))
    return np.array(values)


def read_npz(path: Path) -> NDArray[Any]:
    """Read the only array with two dimensions of a .npz file, whatever its name. Raises SourceError as `read_npy`."""
    refuse_special(path, most=MOST_BYTES)
    with guarded(path, REMEDY, SourceError, "unreadable image"), np.load(path) as file:
        if sum(member.file_size for member in file.zip.infolist()) > MOST_BYTES:
            raise ValueError(f"unzips to more than {MOST_BYTES / 1e6:.0f} MB")
        arrays = [file[name] for name in file.files]
    images: list[NDArray[Any]] = [values for values in arrays if values.ndim == 2]
    if len(images) != 1:
        raise SourceError(f"{path}: holds {[a.shape for a in arrays]}, not one depth image; save one [H, W] per frame")
    return images[0]


def read_exr(path: Path) -> NDArray[np.float32]:
    """Read channel Z, Y or R, else the first, of an EXR file; NaN, Record3D's no reading, is 0. Raises SourceError."""
    openexr = import_optional("OpenEXR", "iphone", f"{path}: depth as EXR")
    refuse_special(path, most=MOST_BYTES)
    try:
        low, high = openexr.File(str(path), header_only=True).header()["dataWindow"]
        check_pixels(path, (int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1))
        channels = openexr.File(str(path), separate_channels=True).channels()
        name = next((name for name in ("Z", "Y", "R") if name in channels), next(iter(channels)))
        return np.nan_to_num(np.asarray(channels[name].pixels, np.float32), posinf=0.0, neginf=0.0)
    except Exception as error:  # the library can raise any C++ exception
        raise SourceError(f"{path}: unreadable EXR file ({error}); export it again") from error
