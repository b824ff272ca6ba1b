"""Write the images of keyframes as PNG: colour, and depth as 16-bit millimetres (0 = no reading)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from sigmasplat.data.submap import Picture
from sigmasplat.errors import RunError
from sigmasplat.files.atomic import make_folder, replacing
from sigmasplat.plugins.outputs.run_reader import RunReader
from sigmasplat.types import Progress

IMAGES, DEPTHS = "images", "depths"
MAX_MM = 65535


def image_name(frame: int) -> str:
    """Return the file name of a frame's images."""
    return f"frame-{frame:06d}.png"


def export_images(reader: RunReader, folder: Path, depth: bool, progress: Progress) -> Sequence[int]:
    """Write the colour of the keyframes to images/, and their depth to depths/ if requested.

    Keyframes without a valid pose are left out. Returns their frame numbers. Raises RunError if no keyframe is left.
    """
    valid, written = set(reader.valid_frames()), []
    total = reader.count_keyframes()
    for done, (frame, picture) in enumerate(reader.keyframes(), 1):
        if frame in valid:
            write_color(folder / IMAGES / image_name(frame), picture)
            if depth:
                write_depth(folder / DEPTHS / image_name(frame), picture)
            written.append(frame)
        progress(done, total)
    if not written:
        raise RunError(f"run {reader.run.path} has no keyframes, so it has no images to export; run it again")
    return written


def write_color(path: Path, picture: Picture) -> None:
    """Write the colour. Raises RunError if the file cannot be written."""
    _write(path, Image.fromarray(picture.color))


def write_depth(path: Path, picture: Picture) -> None:
    """Write the depth; values above 65.5 m become 0. Raises RunError if the file cannot be written."""
    millimetres = np.rint(picture.depth_m.astype(np.float64) * 1000.0)
    _write(path, Image.fromarray(np.where(millimetres <= MAX_MM, millimetres, 0.0).astype(np.uint16)))


def _write(path: Path, image: Image.Image) -> None:
    make_folder(path.parent)
    with replacing(path) as temporary:
        image.save(temporary, "PNG")
