"""Depth, or inverse depth, that a network predicted: a folder with one image per frame, or the network itself."""

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import Lock
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.errors import SourceError
from sigmasplat.files.pictures import read_npy
from sigmasplat.input.calibration import MM_PER_METRE
from sigmasplat.input.depth_units import PLAUSIBLE_MEDIAN_M
from sigmasplat.input.folders import DEPTH_ENDINGS, list_images
from sigmasplat.input.images import read_values
from sigmasplat.input.recorded import first_readable
from sigmasplat.plugins.predicted_depth.depth_model import DepthModel

Floats = NDArray[np.float32]
ReadColor = Callable[[], Floats]
"""Reads the colour of a frame [H, W, 3] in [0, 1]."""

MEDIAN_M = 2.0
"""Median depth of the first image if its unit is unknown: settings in metres expect a room."""
MOST_KEPT_PIXELS = 8_000_000
"""Predictions that are kept, 32 MB."""


class PredictedDepth(ABC):
    """The predicted depth of all frames of a recording, in metres of an arbitrary scale.

    One factor brings all images to the size of a room; it is 1 if the first image already looks like metres (floats) or
    millimetres (whole numbers). paths: what names the depth of each frame in messages; model: name and SHA-256 of the
    file that predicts it, None if it is in files. Raises SourceError if the first frame's cannot be used.
    """

    model: Mapping[str, str] | None = None
    made: ClassVar[str]
    unknown: ClassVar[str]
    """What to check if there is no depth, and what to do about NaN."""

    def __init__(self, paths: Sequence[Path], inverse: bool) -> None:
        self.paths, self._inverse, self._factor = paths, inverse, 1.0

    @abstractmethod
    def values(self, i: int, color: ReadColor) -> NDArray[Any]:
        """Return the prediction for frame i, with the number of each pixel in the last two axes. Raises SourceError."""

    def depth_of(self, i: int, width: int, height: int, color: ReadColor) -> Floats:
        """Return the depth of frame i [height, width], 0 where it is unknown; color: reads the frame's colour. Raises
        SourceError if it cannot be used."""
        depth_m = self._depth(i, color) * np.float32(self._factor)
        if depth_m.shape == (height, width):
            return depth_m
        resized = Image.fromarray(depth_m).resize((width, height), Image.Resampling.NEAREST)
        return np.asarray(resized, np.float32)

    def _find_factor(self, i: int, color: ReadColor) -> None:
        """Find the factor from frame i. Raises SourceError if its depth cannot be used."""
        first = self._depth(i, color)
        known = first[first > 0]
        if not len(known):
            raise SourceError(f"{self.paths[i]}: predicted depth has no value above 0; check how it was {self.made}")
        median = float(np.median(known))
        if self._inverse or not PLAUSIBLE_MEDIAN_M[0] <= median <= PLAUSIBLE_MEDIAN_M[1]:
            self._factor = MEDIAN_M / median

    def _depth(self, i: int, color: ReadColor) -> Floats:
        """Return the depth of one frame, before the factor."""
        values, path = self.values(i, color), self.paths[i]
        if values.ndim == 3 and 1 in values.shape[::2]:
            values = values[..., 0] if values.shape[2] == 1 else values[0]
        if values.ndim != 2 or values.dtype.kind not in "uif":
            raise SourceError(
                f"{path}: not predicted depth (found {values.dtype} {values.shape}); give one number for each pixel"
            )
        read = values.astype(np.float32)
        if bad := int((~np.isfinite(read)).sum()):
            raise SourceError(f"{path}: predicted depth holds {bad} NaN or inf pixels; {self.unknown}")
        if values.dtype.kind in "ui":
            read = read / np.float32(MM_PER_METRE)
        if not self._inverse:
            return np.maximum(read, np.float32(0.0))
        usable = read > np.finfo(np.float32).tiny * 1e6
        return np.where(usable, 1.0 / np.where(usable, read, 1.0), 0.0).astype(np.float32)


class PredictedFolder(PredictedDepth):
    """Predicted depth in a folder, one image for each frame. Raises SourceError if there is not one for each."""

    made, unknown = "stored", "write 0 where it is unknown"

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
        super().__init__(found, inverse)
        self._find_factor(0, no_color)

    def values(self, i: int, color: ReadColor) -> NDArray[Any]:
        """Read the image of frame i."""
        path = self.paths[i]
        return read_npy(path) if path.suffix.lower() == ".npy" else read_values(path)


class PredictedByModel(PredictedDepth):
    """Depth that a network predicts from the colour of a frame when the frame is read.

    Predictions of the newest frames are kept, so that reading a frame again does not predict again. Safe to use from
    several threads.
    """

    made, unknown = "trained, and what colours it expects", "the network does not fit these images"

    def __init__(self, model: DepthModel, frames: int, read_color: Callable[[int], Floats], inverse: bool) -> None:
        """Predict the depth of the first frame whose colour can be read. Raises SourceError if that fails."""
        super().__init__([model.path] * frames, inverse)
        self.model = {"file": model.name, "sha256": model.sha256}
        self._model, self._kept, self._lock = model, OrderedDict[int, Floats](), Lock()
        first, color = first_readable(range(frames), lambda i: (i, read_color(i)))
        self._find_factor(first, lambda: color)

    def values(self, i: int, color: ReadColor) -> Floats:
        """Return the prediction for frame i."""
        with self._lock:
            if i not in self._kept:
                self._kept[i] = self._model.predict(color())
                while len(self._kept) > 1 and sum(kept.size for kept in self._kept.values()) > MOST_KEPT_PIXELS:
                    self._kept.popitem(last=False)
            return self._kept[i]


def no_color() -> Floats:
    """Return no colour, for depth that does not need it."""
    return np.zeros((0, 0, 3), np.float32)
