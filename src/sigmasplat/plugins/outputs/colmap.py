"""Write a run as a sparse model in COLMAP's text format: cameras.txt, images.txt, points3D.txt.

Layout: COLMAP's documentation, "Output Format". Poses are world to camera, quaternions wxyz. The image's corner is
(0, 0) and the first pixel's centre (½, ½), so the principal point is half a pixel larger than in `Camera`. Points have
no tracks, because no features were matched.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.files.atomic import make_folder, write_text
from sigmasplat.plugins.outputs.images import export_images, image_name
from sigmasplat.plugins.outputs.meshes.mesh_files import color_bytes
from sigmasplat.plugins.outputs.points import splat_points
from sigmasplat.plugins.outputs.run_reader import RunReader
from sigmasplat.types import Matrix, Progress, no_progress

SPARSE = Path("sparse") / "0"
"""The folder in which trainers that start from COLMAP look for a model."""
Points = NDArray[np.floating]


def export_colmap(reader: RunReader, target: Path, images: bool = False, progress: Progress = no_progress) -> int:
    """Write a sparse model to sparse/0 in a folder; return the number of views.

    Views are all frames whose pose is valid; with `images` only the keyframes, whose images are written to images/.
    Raises RunError.
    """
    make_folder(target / SPARSE)
    frames = export_images(reader, target, False, progress) if images else reader.valid_frames()
    names = [image_name(frame) for frame in frames]
    poses = reader.poses_of(frames).T_world_camera
    write_model(target / SPARSE, reader.camera, names, poses, *splat_points(reader.run.read_map()))
    return len(frames)


def write_model(
    folder: Path, camera: Camera, names: Sequence[str], T_world_camera: Matrix, points: Points, colors: Points
) -> None:
    """Write a model into an existing folder; all images have the same camera.

    names: the images' file names [N], relative to their folder; T_world_camera [N, 4, 4]; points [P, 3] m in the world;
    colors [P, 3] in [0, 1]. Raises RunError if the files cannot be written.
    """
    write_text(folder / "cameras.txt", _cameras(camera))
    write_text(folder / "images.txt", _images(names, T_world_camera))
    write_text(folder / "points3D.txt", _points(points, colors))


def _cameras(c: Camera) -> str:
    numbers = " ".join(f"{value:.12g}" for value in (c.fx, c.fy, c.cx + 0.5, c.cy + 0.5))
    return f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, FX, FY, CX, CY\n1 PINHOLE {c.width} {c.height} {numbers}\n"


def _images(names: Sequence[str], T_world_camera: Matrix) -> str:
    """Return two lines per image; the second one, for features, is empty."""
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D as (X, Y, POINT3D_ID)"]
    for number, (name, T) in enumerate(zip(names, se3.inverse(T_world_camera), strict=True), 1):
        pose = (*se3.quaternion_from_rotation(T[:3, :3]), *T[:3, 3])
        lines += [f"{number} {' '.join(f'{value:.12g}' for value in pose)} 1 {name}", ""]
    return "\n".join(lines) + "\n"


def _points(points: Points, colors: Points) -> str:
    """Return one line per point; its error is 0 and its track is empty."""
    rows = zip(points.tolist(), color_bytes(colors).tolist(), strict=True)
    lines = (f"{i} {x:.6f} {y:.6f} {z:.6f} {r} {g} {b} 0\n" for i, ((x, y, z), (r, g, b)) in enumerate(rows, 1))
    return "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n" + "".join(lines)
