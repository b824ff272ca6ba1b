"""A sequence of which some pixels are ignored: a mask for each frame says which."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.data.frame import Frame
from sigmasplat.errors import SourceError
from sigmasplat.input.mask_files import MaskFolder
from sigmasplat.input.source import Source, Subset


class Masked(Subset):
    """Another source with a folder of masks: ignored pixels have no depth, and their colour is not used.

    Raises SourceError if the masks do not fit the frames, or the source is a live camera.
    """

    def __init__(self, whole: Source, folder: Path) -> None:
        if whole.live:
            raise SourceError(f"{folder}: masks are for recordings only; record the camera, then run the recording")
        super().__init__(whole, InputConfig())
        self._masks = MaskFolder(folder, len(whole), whole.camera)

    def frame(self, i: int) -> Frame:
        """Read frame i without depth at the ignored pixels."""
        frame, ignored = super().frame(i), self._masks.ignored(i)
        return replace(frame, depth_m=np.where(ignored, np.float32(0.0), frame.depth_m), ignored=ignored)

    def depth_of(self, i: int) -> NDArray[np.float32]:
        """Read the depth of frame i, 0 at the ignored pixels."""
        return np.where(self._masks.ignored(i), np.float32(0.0), super().depth_of(i))
