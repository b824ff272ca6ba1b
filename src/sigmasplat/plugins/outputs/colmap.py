"""Write a run for programs that train on images: views and points as COLMAP's text model.

COLMAP's poses are world to camera, quaternions wxyz; points have no tracks, because no features were matched (COLMAP's
documentation, "Output Format"). The image's corner is (0, 0) and the first pixel's centre (½, ½), so the principal
point is half a pixel larger than in `Camera`.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import sigmasplat.api as api
from sigmasplat.api import Matrix, Progress, se3
from sigmasplat.plugins.outputs.run_reader import RunReader

Points = NDArray[np.floating]

MAX_POINTS = 100_000
MIN_OPACITY = 0.5


def splat_points(field: api.GaussianField, most: int = MAX_POINTS) -> tuple[Matrix, Matrix]:
    """Return the centres [P, 3] m and colours [P, 3] of the opaque splats, evenly thinned to `most`."""
    opaque = np.flatnonzero(field.opacities.numpy() >= MIN_OPACITY)
    rows = opaque[np.linspace(0, len(opaque) - 1, min(most, len(opaque))).astype(int)]
    return field.means.numpy()[rows].astype(np.float64), field.colors.numpy()[rows].astype(np.float64)


IMAGES = "images"


def image_name(frame: int) -> str:
    """Return the file name of a frame's image."""
    return f"frame-{frame:06d}.png"


def export_images(reader: RunReader, folder: Path, progress: Progress) -> Sequence[int]:
    """Write the colour of the keyframes as PNG to images/.

    Keyframes without a valid pose are left out. Returns their frame numbers. Raises RunError if no keyframe is left.
    """
    valid, written = set(reader.valid_frames()), []
    api.make_folder(folder / IMAGES)
    total = reader.count_keyframes()
    for done, (frame, picture) in enumerate(reader.keyframes(), 1):
        if frame in valid:
            with api.replacing(folder / IMAGES / image_name(frame)) as temporary:
                Image.fromarray(picture.color).save(temporary, "PNG")
            written.append(frame)
        progress(done, total)
    if not written:
        raise api.RunError(f"run {reader.run.path} has no keyframes, so it has no images to export; run it again")
    return written


SPARSE = Path("sparse") / "0"
"""The folder in which trainers that start from COLMAP look for a model."""


def export_colmap(reader: RunReader, target: Path, images: bool = False, progress: Progress = api.no_progress) -> int:
    """Write a sparse model to sparse/0 in a folder; return the number of views.

    Views are all frames whose pose is valid; with `images` only the keyframes, whose images are written to images/.
    Raises RunError.
    """
    api.make_folder(target / SPARSE)
    frames = export_images(reader, target, progress) if images else reader.valid_frames()
    names = [image_name(frame) for frame in frames]
    poses = reader.poses_of(frames).T_world_camera
    write_model(target / SPARSE, reader.camera, names, poses, *splat_points(reader.run.read_map()))
    return len(frames)


def write_model(
    folder: Path, camera: api.Camera, names: Sequence[str], T_world_camera: Matrix, points: Points, colors: Points
) -> None:
    """Write a model into an existing folder; all images have the same camera.

    names: the images' file names [N], relative to their folder; T_world_camera [N, 4, 4]; points [P, 3] m in the world;
    colors [P, 3] in [0, 1]. Raises RunError if the files cannot be written.
    """
    numbers = " ".join(f"{value:.12g}" for value in (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5))
    head = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, FX, FY, CX, CY\n"
    api.write_text(folder / "cameras.txt", f"{head}1 PINHOLE {camera.width} {camera.height} {numbers}\n")
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D as (X, Y, POINT3D_ID)"]
    for number, (name, T) in enumerate(zip(names, se3.inverse(T_world_camera), strict=True), 1):
        pose = (*se3.quaternion_from_rotation(T[:3, :3]), *T[:3, 3])
        lines += [f"{number} {' '.join(f'{value:.12g}' for value in pose)} 1 {name}", ""]  # no features
    api.write_text(folder / "images.txt", "\n".join(lines) + "\n")
    rows = zip(points.tolist(), api.to_bytes(colors * 255.0).tolist(), strict=True)
    made = (f"{i} {x:.6f} {y:.6f} {z:.6f} {r} {g} {b} 0\n" for i, ((x, y, z), (r, g, b)) in enumerate(rows, 1))
    head = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    api.write_text(folder / "points3D.txt", head + "".join(made))
