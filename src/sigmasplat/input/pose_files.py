"""Read camera poses stored as matrices; every problem becomes a SourceError that names the file."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sigmasplat.data import se3
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.files.reading import read_text
from sigmasplat.types import Matrix

MOST_MATRIX_BYTES = 1 << 16

RIGID_TOLERANCE = 1e-2
"""Published poses are rounded; a matrix within this tolerance of a rotation is orthonormalised."""

QUATERNION_TOLERANCE = 1e-2
"""Largest deviation of a recorded quaternion's length from 1."""

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
"""Transforms camera axes with y down and z forward to axes with y up and z backward (OpenGL)."""


def read_matrix(path: Path) -> Matrix:
    """Read 3×4 or 4×4 numbers by rows as [4, 4]; they may be infinite. Raises SourceError naming the file."""
    text = read_text(path, most=MOST_MATRIX_BYTES)
    try:
        return to_matrix(str(path), [float(word) for word in text.replace(",", " ").split()])
    except ValueError as error:
        raise SourceError(f"{path}: not readable as a matrix of numbers ({error}); download it again") from error


def to_matrix(where: str, values: Any) -> Matrix:
    """Shape 12 or 16 numbers as [4, 4]. Raises SourceError naming `where` for any other count."""
    try:
        flat = np.array(values, np.float64).reshape(-1)
    except (ValueError, TypeError):
        flat = np.zeros(0)
    if len(flat) not in (12, 16):
        raise SourceError(f"{where}: expected a 4×4 matrix by rows, found {_described(values)}")
    return np.vstack([flat[:12].reshape(3, 4), flat[12:].reshape(-1, 4) if len(flat) == 16 else [[0, 0, 0, 1]]])


def _described(values: Any) -> str:
    return f"{len(values)} values" if isinstance(values, list) else repr(values)[:60]


def checked_pose(where: str, T: Matrix) -> Matrix | None:
    """Return a camera-to-world pose, None if it is not finite, which marks a frame without a pose.

    Raises SourceError naming `where` if the matrix is finite but not rigid.
    """
    if not np.isfinite(T).all():
        return None
    if not se3.is_rigid(T, RIGID_TOLERANCE):
        numbers = " ".join(f"{value:.3g}" for value in T.reshape(-1)[:12])
        raise SourceError(f"{where}: not a rigid camera-to-world pose: {numbers}; delete it or correct its rotation")
    return T if se3.is_rigid(T) else se3.orthonormalise(T)


def rigid_transform(where: str, position: ArrayLike, quaternion_wxyz: ArrayLike) -> Matrix:
    """Build a transform [4, 4]. Raises SourceError naming `where` unless it is finite with a unit quaternion."""
    q, T = np.array(quaternion_wxyz, np.float64), np.eye(4)
    T[:3, 3] = position
    norm = float(np.linalg.norm(q))
    if not np.isfinite(T).all() or not abs(norm - 1.0) < QUATERNION_TOLERANCE:
        raise SourceError(f"{where}: the pose is not rigid: its quaternion has length {norm:.4g}, not 1")
    T[:3, :3] = se3.rotation_from_quaternion(q)
    return T


def build_trajectory(timed: Iterable[tuple[float, Matrix | None]]) -> Trajectory | None:
    """Build the path of the frames (time in seconds, T_world_camera) that have a pose, None if no frame has one."""
    known = [(t, T) for t, T in timed if T is not None]
    return Trajectory(np.array([t for t, _ in known]), np.stack([T for _, T in known])) if known else None


def read_pose_files(timed: Iterable[tuple[float, Path]]) -> Trajectory | None:
    """Read one pose file per frame, given with its time; a missing file means an unknown pose."""
    return build_trajectory((t, checked_pose(str(path), read_matrix(path))) for t, path in timed if path.is_file())
