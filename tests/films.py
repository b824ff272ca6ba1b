"""Films read back."""

from pathlib import Path

import cv2
import numpy as np


def read_film(path: Path) -> tuple[list[np.ndarray], float]:
    """Return the images, RGB, and the rate of a film, as OpenCV reads them."""
    film, frames = cv2.VideoCapture(str(path)), []
    while (got := film.read())[0]:
        frames.append(got[1][..., ::-1])
    return frames, film.get(cv2.CAP_PROP_FPS)
