"""Write a run as nerfstudio's transforms.json, which instant-ngp and most trainers of radiance fields read.

Layout: nerfstudio's documentation, "Data conventions". Cameras have OpenGL's axes: x right, y up, z backwards. The
image's corner is (0, 0) and the first pixel's centre (½, ½), so the principal point is half a pixel larger than in
`Camera`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sigmasplat.data.camera import Camera
from sigmasplat.files.json_files import write_json
from sigmasplat.plugins.outputs.images import DEPTHS, IMAGES, export_images, image_name
from sigmasplat.plugins.outputs.points import splat_points, write_points
from sigmasplat.plugins.outputs.run_reader import RunReader
from sigmasplat.types import Matrix, Progress, no_progress

POINTS = "points.ply"
T_GL_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])
"""From `Camera`'s axes to OpenGL's; it is its own inverse."""
MILLIMETRES = 0.001


def export_nerfstudio(reader: RunReader, target: Path, images: bool = False, progress: Progress = no_progress) -> int:
    """Write transforms.json; return the number of views.

    Views are all frames whose pose is valid; with `images` only the keyframes, whose images are written to images/
    and depths/ beside the file, with points.ply. The images' names are the same in both cases. Raises RunError.
    """
    frames = export_images(reader, target.parent, True, progress) if images else reader.valid_frames()
    path = reader.poses_of(frames)
    if images:
        write_points(target.parent / POINTS, *splat_points(reader.run.read_map()))
    write_transforms(
        target,
        reader.camera,
        [f"{IMAGES}/{image_name(frame)}" for frame in frames],
        path.T_world_camera,
        path.timestamps_s.tolist(),
        depth_names=[f"{DEPTHS}/{image_name(frame)}" for frame in frames] if images else None,
        points_name=POINTS if images else None,
    )
    return len(frames)


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
    """Write views: the images' file names relative to the file, T_world_camera [N, 4, 4], times.

    depth_names: 16-bit images in millimetres; points_name: a PLY with the initial points. Raises RunError if the file
    cannot be written.
    """
    frames = [
        {"file_path": name, "timestamp_s": float(t), "transform_matrix": T @ T_GL_CAMERA}
        for name, t, T in zip(names, timestamps_s, T_world_camera, strict=True)
    ]
    for frame, depth_name in zip(frames, depth_names or (), strict=bool(depth_names)):
        frame["depth_file_path"] = depth_name
    depth = {"depth_unit_scale_factor": MILLIMETRES} if depth_names else {}
    points = {"ply_file_path": points_name} if points_name else {}
    write_json(path, _intrinsics(camera) | depth | points | {"frames": frames})


def _intrinsics(camera: Camera) -> dict[str, Any]:
    """Return the camera in nerfstudio's terms: a pinhole is OPENCV without distortion."""
    return {
        "camera_model": "OPENCV", "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy,
        "cx": camera.cx + 0.5, "cy": camera.cy + 0.5, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
    }  # fmt: skip
