"""Describe the two cameras of a stereo pair, and read them from calibration.json."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmasplat.data.camera import Camera
from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import (
    Calibration,
    Distortion,
    check_positive,
    json_number,
    read_camera,
    read_distortion,
    read_json_object,
    read_rigid_transform,
)
from sigmasplat.types import Matrix


@dataclass(frozen=True, eq=False)
class StereoCameras:
    """Two cameras, rectified or not. T_right_left [4, 4] transforms points of the left camera to the right one, m."""

    left: Camera
    right: Camera
    T_right_left: Matrix
    left_distortion: Distortion | None = None
    right_distortion: Distortion | None = None

    @property
    def rectified(self) -> bool:
        """Return whether the rows of both images correspond without any remapping."""
        x, y, z = self.T_right_left[:3, 3]
        parallel = np.allclose(self.T_right_left[:3, :3], np.eye(3), atol=1e-6) and max(abs(y), abs(z)) < 1e-4 * abs(x)
        return self.left == self.right and parallel and not (self.left_distortion or self.right_distortion)


def read_stereo_cameras(path: Path, left: Calibration) -> StereoCameras:
    """Read what `calibration.json` says of the right camera: baseline_m; or right_camera and T_right_left.

    Without right_camera, the right camera equals the left one. Raises SourceError naming file and field.
    """
    fields = read_json_object(path)
    camera, lens = left.camera, left.distortion
    inner = fields.get("right_camera")
    if inner is not None:
        if not isinstance(inner, dict):
            raise SourceError(f'{path}: field "right_camera" is {inner!r}, expected an object with fx, fy, cx, cy')
        camera = read_camera(path, inner, (camera.width, camera.height))
        lens = read_distortion(path, inner)
    if "T_right_left" in fields:
        T_right_left = read_rigid_transform(path, fields, "T_right_left")
        return StereoCameras(left.camera, camera, T_right_left, left.distortion, lens)
    T_right_left = np.eye(4)
    T_right_left[0, 3] = -check_positive(path, "baseline_m", json_number(path, fields, "baseline_m"))
    return StereoCameras(left.camera, camera, T_right_left, left.distortion, lens)
