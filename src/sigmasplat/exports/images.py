"""Write what keyframes saw as PNG: colour, and depth as 16-bit millimetres, 0 = no reading."""

from pathlib import Path

import numpy as np
from PIL import Image

from sigmasplat.errors import RunError
from sigmasplat.io.atomic import replacing
from sigmasplat.model.submap import Picture

MOST_MM = 65535


def write_color(path: Path, picture: Picture) -> None:
    """Write the colour. Raises RunError if not writable."""
    _write(path, Image.fromarray(picture.color))


def write_depth(path: Path, picture: Picture) -> None:
    """Write the depth; beyond 65.5 m is no reading. Raises RunError if not writable."""
    millimetres = np.rint(picture.depth_m.astype(np.float64) * 1000.0)
    _write(path, Image.fromarray(np.where(millimetres <= MOST_MM, millimetres, 0.0).astype(np.uint16)))


def _write(path: Path, image: Image.Image) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise RunError(
            f"cannot write {path.parent}: {problem.strerror or problem}; choose a writable place"
        ) from problem
    with replacing(path) as temporary:
        image.save(temporary, "PNG")
