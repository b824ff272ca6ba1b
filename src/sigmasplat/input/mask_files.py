"""Ignore pixels of a sequence: a folder of masks, one image per frame, non-zero = ignore."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.data.camera import Camera
from sigmasplat.errors import SourceError
from sigmasplat.input.folders import COLOR_ENDINGS, list_images
from sigmasplat.input.images import image_size, read_values

SAME_SHAPE = 0.02
"""Masks may have another size than the images, but the same ratio of width and height, within this share."""


class MaskFolder:
    """Masks of all frames of a sequence, in the order of the numbers in their names.

    Raises SourceError if there is not one mask for each frame, or one has another shape than the images.
    """

    def __init__(self, folder: Path, frames: int, camera: Camera) -> None:
        if not folder.is_dir():
            raise SourceError(f"no such folder: {folder}; give the folder of the masks, one image for each frame")
        self._paths, self._camera = list_images(folder, COLOR_ENDINGS), camera
        if len(self._paths) != frames:
            raise SourceError(f"{folder}: found {len(self._paths)} masks for {frames} frames; give one for each frame")
        for path in self._paths:
            self._refuse_other_shape(path, image_size(path))

    def ignored(self, i: int) -> NDArray[np.bool_]:
        """Return the pixels [H, W] of frame i that are ignored. Raises SourceError if its mask cannot be used."""
        path, c = self._paths[i], self._camera
        values = read_values(path)
        chosen = values != 0 if values.ndim == 2 else (values[..., :3] != 0).any(-1)
        if chosen.shape != (c.height, c.width):
            chosen = np.asarray(Image.fromarray(chosen).resize((c.width, c.height), Image.Resampling.NEAREST))
        return np.asarray(chosen, np.bool_)

    def _refuse_other_shape(self, path: Path, size: tuple[int, int]) -> None:
        (width, height), c = size, self._camera
        if abs(width * c.height - height * c.width) > SAME_SHAPE * width * c.height:
            raise SourceError(
                f"{path}: the mask is {width}×{height}, but the images are {c.width}×{c.height}; "
                "make masks of the images' shape"
            )
