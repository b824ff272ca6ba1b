"""Read the transforms.json of instant-ngp and nerfstudio: one camera, poses with OpenGL axes.

fl_x fl_y cx cy w h [k1 k2 k3 p1 p2] [camera_model]     at the top, or in every frame
frames: file_path, depth_file_path, transform_matrix    camera to world; camera x right, y up, z backward

In these files the centre of the first pixel is at (½, ½), in ours at (0, 0): half a pixel is subtracted from cx and cy.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import Calibration, Distortion, json_number, median_calibration
from sigmasplat.input.lists import FLIP_YZ, checked_pose, to_matrix
from sigmasplat.types import Matrix

Fields = dict[str, Any]

PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
LENS = ("k1", "k2", "p1", "p2", "k3", "k4")
SAME_LENS = 0.01


def read_frames(path: Path, fields: Fields, key: str = "frames") -> list[Fields]:
    """Return the frames of a file. Raises SourceError if there are none, or one has no image path."""
    frames = fields.get(key)
    if not isinstance(frames, list) or not frames:
        raise SourceError(f'{path}: no list "{key}" with at least one frame; was it written by nerfstudio?')
    for frame in frames:
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise SourceError(f'{path}: a frame has no "file_path" (found {str(frame)[:60]}); correct it')
    return frames


def read_transforms_camera(
    path: Path, fields: Fields, frames: Sequence[Fields], size: tuple[int, int], units: float
) -> Calibration:
    """Build the camera of the frames (`median_calibration`); `size` (width, height) is the default for a missing size.

    Raises SourceError naming a missing field, a frame of other size or lens, or a lens that is not a pinhole's.
    """
    first = {**fields, **frames[0]}
    model = str(first.get("camera_model", "OPENCV")).upper()
    if model not in PINHOLE_MODELS or first.get("is_fisheye"):
        raise SourceError(
            f"{path}: camera_model is {model}; only pinhole cameras are supported, undistort the images first"
        )
    for frame in frames[1:]:
        for key in ("w", "h", *LENS):
            a, b = (json_number(path, found, key, 0.0) for found in (first, {**first, **frame}))
            if abs(a - b) > (SAME_LENS if key in LENS else 0.0):
                raise SourceError(
                    f"{path}: the frames have several cameras ({key} {a:g} and {b:g}, {frame['file_path']}); "
                    "all frames must have one camera: undistort the images to one camera, or remove the others"
                )
    width, height = (int(json_number(path, first, key, size[i])) for i, key in enumerate(("w", "h")))
    focals = np.array([_focal(path, {**first, **frame}, width, height) for frame in frames])
    return replace(median_calibration(path, (width, height), focals, units), distortion=_lens(path, first))


def read_pose(path: Path, frame: Fields) -> Matrix | None:
    """Return T_world_camera in our axes, None if the frame has no pose. Raises SourceError if it is not rigid."""
    values = frame.get("transform_matrix")
    if values is None:
        return None
    where = f"{path}, {frame['file_path']}"
    T = checked_pose(where, to_matrix(where, values))
    return None if T is None else T @ FLIP_YZ


def _focal(path: Path, fields: Fields, width: int, height: int) -> list[float]:
    """Return fx, fy, cx, cy; a file may give the field of view instead of the focal length."""
    if "fl_x" not in fields and "camera_angle_x" in fields:
        angle = json_number(path, fields, "camera_angle_x")
        if not 0.0 < angle < np.pi:
            raise SourceError(
                f'{path}: field "camera_angle_x" is {angle:g}, expected a field of view in radians, 0 to π'
            )
        fx = 0.5 * width / float(np.tan(0.5 * angle))
    else:
        fx = json_number(path, fields, "fl_x")
    fy = json_number(path, fields, "fl_y", fx)
    cx, cy = json_number(path, fields, "cx", width / 2), json_number(path, fields, "cy", height / 2)
    return [fx, fy, cx - 0.5, cy - 0.5]


def _lens(path: Path, fields: Fields) -> Distortion | None:
    k1, k2, p1, p2, k3, k4 = (json_number(path, fields, key, 0.0) for key in LENS)
    if k4:
        raise SourceError(f"{path}: the lens has k4 = {k4:g}, which is not supported; undistort the images first")
    return (k1, k2, p1, p2, k3) if any((k1, k2, p1, p2, k3)) else None
