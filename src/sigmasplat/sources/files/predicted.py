"""Read depth that a network predicted: a folder with one image per frame, of depth or of inverse depth."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.errors import SourceError
from sigmasplat.reading.pictures import read_npy
from sigmasplat.sources.camera.calibration import MM_PER_METRE
from sigmasplat.sources.camera.depth_units import PLAUSIBLE_MEDIAN_M
from sigmasplat.sources.files.folders import DEPTH_ENDINGS, list_images
from sigmasplat.sources.files.images import read_values

Floats = NDArray[np.float32]

MEDIAN_M = 2.0
"""Median depth of the first image if its unit is unknown: settings in metres expect a room."""


class PredictedFolder:
    """The predicted depth of all frames of a recording, in metres of an arbitrary scale.

    One factor brings all images to the size of a room; it is 1 if the first image already looks like metres (floats) or
    millimetres (whole numbers). Raises SourceError if there is not one image for each frame, or the first one cannot be
    used.
    """

    def __init__(self, folder: Path, names: Sequence[str], inverse: bool) -> None:
        """Find the images of the frames: by name if the first frame's name (without ending) occurs, else in order.

        names: those of the frames, or empty names if only the order counts; inverse: whether values are inverse depth.
        """
        if not folder.is_dir():
            raise SourceError(f"no such folder: {folder}; give the folder of the predicted depth, one image per frame")
        found = list_images(folder, DEPTH_ENDINGS)
        by_name = {path.stem: path for path in found}
        if names and names[0] in by_name:
            missing = [name for name in names if name not in by_name]
            if missing:
                raise SourceError(
                    f"{folder}: no predicted depth for {len(missing)} of {len(names)} frames (first: {missing[0]}); "
                    "predict it for every frame"
                )
            found = [by_name[name] for name in names]
        if len(found) != len(names):
            raise SourceError(
                f"{folder}: found predicted depth of {len(found)} frames, there are {len(names)}; give one for each"
            )
        self.paths, self._inverse, self._factor = found, inverse, 1.0
        first = self._depth(found[0])
        known = first[first > 0]
        if not len(known):
            raise SourceError(f"{found[0]}: predicted depth has no value above 0; check how it was stored")
        median = float(np.median(known))
        if inverse or not PLAUSIBLE_MEDIAN_M[0] <= median <= PLAUSIBLE_MEDIAN_M[1]:
            self._factor = MEDIAN_M / median

    def depth_of(self, i: int, width: int, height: int) -> Floats:
        """Return the depth of frame i [height, width], 0 where it is unknown. Raises SourceError if the file cannot be
        used."""
        depth_m = self._depth(self.paths[i]) * np.float32(self._factor)
        if depth_m.shape == (height, width):
            return depth_m
        resized = Image.fromarray(depth_m).resize((width, height), Image.Resampling.NEAREST)
        return np.asarray(resized, np.float32)

    def _depth(self, path: Path) -> Floats:
        """Read one image, before the factor."""
        values = read_npy(path) if path.suffix.lower() == ".npy" else read_values(path)
        if values.ndim == 3 and 1 in values.shape[::2]:
            values = values[..., 0] if values.shape[2] == 1 else values[0]
        if values.ndim != 2 or values.dtype.kind not in "uif":
            raise SourceError(
                f"{path}: not predicted depth (found {values.dtype} {values.shape}); give one number for each pixel"
            )
        read = values.astype(np.float32)
        if bad := int((~np.isfinite(read)).sum()):
            raise SourceError(f"{path}: predicted depth holds {bad} NaN or inf pixels; write 0 where it is unknown")
        if values.dtype.kind in "ui":
            read = read / np.float32(MM_PER_METRE)
        if not self._inverse:
            return np.maximum(read, np.float32(0.0))
        usable = read > np.finfo(np.float32).tiny * 1e6
        return np.where(usable, 1.0 / np.where(usable, read, 1.0), 0.0).astype(np.float32)
