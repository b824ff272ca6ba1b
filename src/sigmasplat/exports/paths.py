"""Write a run's path: KITTI, nerfstudio's transforms.json, COLMAP's text model; pictures beside it where asked for."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import RunError
from sigmasplat.exports.colmap import write_model
from sigmasplat.exports.images import write_color, write_depth
from sigmasplat.exports.nerfstudio import write_transforms
from sigmasplat.exports.points import write_points
from sigmasplat.exports.recorded import Recorded
from sigmasplat.io.trajectory import write_kitti_poses
from sigmasplat.types import Progress

IMAGES, DEPTHS, POINTS = "images", "depths", "points.ply"
SPARSE = Path("sparse") / "0"
"""Where trainers that start from COLMAP look for a model."""
MOST_POINTS = 100_000
LEAST_OPACITY = 0.5

Floats = NDArray[np.float64]


def untold(done: int, total: int) -> None:
    """Tell nobody."""


def export_kitti(recorded: Recorded, target: Path) -> int:
    """Write the poses of all frames, lost ones too, since a line's number is its frame; return how many.

    Raises RunError.
    """
    write_kitti_poses(target, recorded.path)
    return len(recorded.path)


def export_transforms(recorded: Recorded, target: Path, pictures: bool = False, progress: Progress = untold) -> int:
    """Write transforms.json; with `pictures` of the keyframes alone, and images/, depths/ and points.ply beside it.

    Without, of all frames that were not lost, their names those that `pictures` would give. Returns how many. Raises
    RunError.
    """
    frames = write_pictures(recorded, target.parent, True, progress) if pictures else recorded.frames()
    if pictures:
        write_points(target.parent / POINTS, *map_points(recorded))
    write_transforms(
        target,
        recorded.camera,
        [f"{IMAGES}/{picture_name(frame)}" for frame in frames],
        recorded.path.T_world_camera[frames],
        recorded.path.timestamps_s[frames].tolist(),
        depth_names=[f"{DEPTHS}/{picture_name(frame)}" for frame in frames] if pictures else None,
        points_name=POINTS if pictures else None,
    )
    return len(frames)


def export_colmap(recorded: Recorded, target: Path, pictures: bool = False, progress: Progress = untold) -> int:
    """Write a sparse model to sparse/0 in a folder; with `pictures` of the keyframes, which go to images/.

    Without, of all frames that were not lost. Returns how many. Raises RunError.
    """
    model = target / SPARSE
    try:
        model.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise RunError(f"cannot write {model}: {problem.strerror or problem}; choose a writable place") from problem
    frames = write_pictures(recorded, target, False, progress) if pictures else recorded.frames()
    names = [picture_name(frame) for frame in frames]
    poses = recorded.path.T_world_camera[frames]
    write_model(model, recorded.camera, names, poses, *map_points(recorded))
    return len(frames)


def picture_name(frame: int) -> str:
    """Name a frame's picture."""
    return f"frame-{frame:06d}.png"


def write_pictures(recorded: Recorded, folder: Path, depth: bool = False, progress: Progress = untold) -> Sequence[int]:
    """Write what the keyframes saw, but lost ones; return their frames. Raises RunError if there is none."""
    trusted, written = set(recorded.frames()), []
    total = recorded.count_keyframes()
    for done, (frame, picture) in enumerate(recorded.keyframes(), 1):
        if frame in trusted:
            write_color(folder / IMAGES / picture_name(frame), picture)
            if depth:
                write_depth(folder / DEPTHS / picture_name(frame), picture)
            written.append(frame)
        progress(done, total)
    if not written:
        raise RunError(f"run {recorded.run.path} has no keyframes to make pictures of; run it again")
    return written


def map_points(recorded: Recorded, most: int = MOST_POINTS) -> tuple[Floats, Floats]:
    """Return the centres [P, 3] m and colours [P, 3] of the map's opaque splats, evenly thinned to `most`."""
    field = recorded.run.read_map()
    rows = np.flatnonzero(field.opacities.numpy() >= LEAST_OPACITY)
    rows = rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)]
    return field.means.numpy()[rows].astype(np.float64), field.colors.numpy()[rows].astype(np.float64)
