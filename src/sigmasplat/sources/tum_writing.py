"""Write a sequence in the layout of the TUM RGB-D benchmark, frame by frame, so that it can be read at any moment."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from PIL import Image

from sigmasplat.errors import RunError
from sigmasplat.model.camera import Camera
from sigmasplat.model.frame import Frame
from sigmasplat.sources.calibration import TUM_UNITS_PER_METRE
from sigmasplat.sources.images import OVERFLOW


class TumWriter:
    """Adds frames to a new TUM folder: both images first, then a line in each list."""

    def __init__(self, folder: Path, camera: Camera) -> None:
        """Raises RunError if the folder already holds a sequence or cannot be written."""
        self.folder = folder
        if (folder / "rgb.txt").exists():
            raise RunError(f"{folder} already holds a sequence (rgb.txt); give another folder")
        try:
            for part in ("rgb", "depth"):
                (folder / part).mkdir(parents=True, exist_ok=True)
            calibration = asdict(camera) | {"depth_scale": TUM_UNITS_PER_METRE}
            (folder / "calibration.json").write_text(json.dumps(calibration, indent=1) + "\n")
        except OSError as error:
            raise RunError(f"cannot write the sequence to {folder} ({error})") from error

    def add(self, frame: Frame) -> None:
        """Write one more frame; times must grow. Raises RunError if the folder cannot be written."""
        try:
            stem = write_images(frame, self.folder)
            for part in ("depth", "rgb"):
                with (self.folder / f"{part}.txt").open("a", encoding="utf-8") as file:
                    file.write(f"{stem} {part}/{stem}.png\n")
        except OSError as error:
            raise RunError(f"cannot write the sequence to {self.folder} ({error})") from error


def write_images(frame: Frame, folder: Path) -> str:
    """Write rgb/T.png and depth/T.png, 1/5000 m, and return T; readings past 13.1 m do not fit and become 0."""
    stem = f"{frame.timestamp_s:.6f}"
    units = np.rint(frame.depth_m * TUM_UNITS_PER_METRE)
    depth = np.where(units < OVERFLOW, units, 0).astype(np.uint16)
    color = np.rint(frame.color * 255.0).astype(np.uint8)
    Image.fromarray(color).save(folder / "rgb" / f"{stem}.png", compress_level=1)
    Image.fromarray(depth).save(folder / "depth" / f"{stem}.png", compress_level=1)
    return stem
