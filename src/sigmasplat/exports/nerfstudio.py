"""Write views as nerfstudio's transforms.json, which instant-ngp and most trainers of radiance fields read.

Layout: nerfstudio's documentation, "Data conventions". Cameras are OpenGL's, x right, y up, z backwards. The image's
corner is (0, 0) and the first pixel's centre (½, ½), so the principal point is half a pixel more than ours.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sigmasplat.io.json_files import write_json
from sigmasplat.model.camera import Camera
from sigmasplat.types import Matrix

OPENGL_FROM_OURS = np.diag([1.0, -1.0, -1.0, 1.0])
"""T_gl_camera, and its own inverse."""
MILLIMETRES = 0.001


def write_transforms(
    path: Path,
    camera: Camera,
    names: Sequence[str],
    T_world_camera: Matrix,
    timestamps_s: Sequence[float],
    *,
    depth_names: Sequence[str] | None = None,
    points_name: str | None = None,
) -> None:
    """Write views: names of their pictures relative to the file, T_world_camera [N, 4, 4], times.

    depth_names: of 16-bit pictures in millimetres; points_name: of a PLY to begin from. Raises RunError if not
    writable.
    """
    frames = [
        {"file_path": name, "timestamp_s": float(t), "transform_matrix": T @ OPENGL_FROM_OURS}
        for name, t, T in zip(names, timestamps_s, T_world_camera, strict=True)
    ]
    for frame, depth_name in zip(frames, depth_names or (), strict=bool(depth_names)):
        frame["depth_file_path"] = depth_name
    depth = {"depth_unit_scale_factor": MILLIMETRES} if depth_names else {}
    points = {"ply_file_path": points_name} if points_name else {}
    write_json(path, _intrinsics(camera) | depth | points | {"frames": frames})


def _intrinsics(camera: Camera) -> dict[str, Any]:
    """Return the camera in nerfstudio's words: a pinhole is OPENCV without distortion."""
    return {
        "camera_model": "OPENCV", "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy,
        "cx": camera.cx + 0.5, "cy": camera.cy + 0.5, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
    }  # fmt: skip
