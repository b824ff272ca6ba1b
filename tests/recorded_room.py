"""Write frames of the synthetic room as a folder of images. A mirrored room exists nowhere else."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from sigmasplat.data.frame import Frame

OPTIONS = ("--fx", "128", "--cx", "79.5", "--cy", "59.5", "--depth-scale", "1000")
"""Options of `run` for the images of a frame of 160×120 pixels."""


def mirrored(frame: Frame) -> Frame:
    return replace(frame, color=frame.color[:, ::-1].copy(), depth_m=frame.depth_m[:, ::-1].copy())


def write_images(folder: Path, frames: Iterable[Frame]) -> Path:
    for name in ("color", "depth"):
        (folder / name).mkdir(parents=True)
    for i, frame in enumerate(frames):
        Image.fromarray(np.rint(255 * frame.color).astype(np.uint8)).save(folder / f"color/{i:04d}.png")
        Image.fromarray(np.rint(1000 * frame.depth_m).astype(np.uint16)).save(folder / f"depth/{i:04d}.png")
    return folder
