"""Read and write paths as TUM text, one pose per line: `t tx ty tz qx qy qz qw` (seconds, metres, T_world_camera)."""

from pathlib import Path

import numpy as np

from sigmasplat.data import se3
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.files.atomic import write_text
from sigmasplat.files.reading import read_text
from sigmasplat.types import Matrix

COLUMNS = "t tx ty tz qx qy qz qw"


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write T_world_camera as TUM text with nanoseconds and 12 significant digits.

    Raises RunError if the file cannot be written.
    """
    lines = [f"# {COLUMNS} (seconds, metres, camera to world)"]
    for t, T in zip(trajectory.timestamps_s, trajectory.T_world_camera, strict=True):
        lines.append(pose_line(t, T))
    write_text(path, "\n".join(lines) + "\n")


def pose_line(t: float, T: Matrix) -> str:
    """Return a pose [4, 4] at a time, seconds, as a line of TUM text."""
    w, x, y, z = se3.quaternion_from_rotation(T[:3, :3])
    return f"{t:.9f} " + " ".join(f"{value:.12g}" for value in (*T[:3, 3], x, y, z, w))


def read_trajectory(path: Path, may_be_empty: bool = False) -> Trajectory:
    """Read TUM text; empty lines and comments after # are skipped.

    Raises SourceError with file and line if it is missing, not text, empty (unless `may_be_empty`), or if a line does
    not have eight finite numbers or has a zero quaternion.
    """
    lines = read_text(path).splitlines()
    stripped = ((number, line.split("#")[0].strip()) for number, line in enumerate(lines, 1))
    rows = [_parse(line, f"{path}:{number}") for number, line in stripped if line]
    if not rows and not may_be_empty:
        raise SourceError(f"no poses in {path} (expected lines of '{COLUMNS}')")
    table = np.array(rows, np.float64).reshape(-1, 8)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = se3.rotation_from_quaternion(table[:, [7, 4, 5, 6]])
    poses[:, :3, 3] = table[:, 1:4]
    return Trajectory(table[:, 0], poses)


def _parse(line: str, where: str) -> list[float]:
    """Parse a line into eight numbers. Raises SourceError with the place `where`."""
    try:
        values = [float(word) for word in line.split()]
    except ValueError as problem:
        raise SourceError(f"{where}: not numbers: {line[:60]!r} (expected '{COLUMNS}')") from problem
    if len(values) != 8:
        raise SourceError(f"{where}: {len(values)} numbers, expected 8: '{COLUMNS}'")
    if not np.isfinite(values).all():
        raise SourceError(f"{where}: the pose has nan or inf; remove the line: {line[:60]!r}")
    if np.linalg.norm(values[4:]) < 1e-6:
        raise SourceError(f"{where}: the quaternion is zero, which is not a rotation; identity is '0 0 0 1'")
    return values


def write_kitti_poses(path: Path, T_world_camera: Matrix) -> None:
    """Write poses [F, 4, 4] as KITTI text, 3×4 matrices with 12 significant digits; nan for a frame without a pose.

    Raises RunError if the file cannot be written.
    """
    rows = (T[:3].ravel().tolist() for T in T_world_camera)
    write_text(path, "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows))
