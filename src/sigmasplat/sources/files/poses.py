"""Read camera poses that lie as matrices in files; whatever is wrong with one becomes a line that names it."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from sigmasplat.errors import SourceError
from sigmasplat.model import se3
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.types import Matrix

RIGID_TOLERANCE = 1e-2
"""Published poses are rounded, or products of many; what is this near a rotation is made one."""

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
"""Takes points of a camera with y down and z forward to the same camera with y up and z backward (OpenGL)."""


def read_matrix(path: Path) -> Matrix:
    """Read 3×4 or 4×4 numbers in rows as [4, 4]; they need not be finite. Raises SourceError naming the file."""
    try:
        text = path.read_text(encoding="utf-8")
        return to_matrix(str(path), [float(word) for word in text.replace(",", " ").split()])
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: not readable as a matrix of numbers ({error}); download it again") from error


def to_matrix(where: str, values: Any) -> Matrix:
    """Shape 12 or 16 numbers as [4, 4]. Raises SourceError naming the place if they are not so many numbers."""
    try:
        flat = np.array(values, np.float64).reshape(-1)
    except (ValueError, TypeError):
        flat = np.zeros(0)
    if len(flat) not in (12, 16):
        raise SourceError(f"{where}: a 4×4 matrix in rows is wanted, found {_described(values)}")
    return np.vstack([flat[:12].reshape(3, 4), flat[12:].reshape(-1, 4) if len(flat) == 16 else [[0, 0, 0, 1]]])


def _described(values: Any) -> str:
    return f"{len(values)} values" if isinstance(values, list) else repr(values)[:60]


def checked_pose(where: str, T: Matrix) -> Matrix | None:
    """Return a camera-to-world pose, None where it is not finite: so recordings mark frames without one.

    Raises SourceError naming the place if the matrix is finite but no rigid motion.
    """
    if not np.isfinite(T).all():
        return None
    if not se3.is_rigid(T, RIGID_TOLERANCE):
        numbers = " ".join(f"{value:.3g}" for value in T.reshape(-1)[:12])
        raise SourceError(f"{where}: not a rigid camera-to-world pose: {numbers}; drop it or mend its rotation")
    return T if se3.is_rigid(T) else se3.orthonormalise(T)


def build_trajectory(timed: Iterable[tuple[float, Matrix | None]]) -> Trajectory | None:
    """Build the path of the frames (time in seconds, T_world_camera) that have a pose, None if none has."""
    known = [(t, T) for t, T in timed if T is not None]
    return Trajectory(np.array([t for t, _ in known]), np.stack([T for _, T in known])) if known else None


def read_pose_files(timed: Iterable[tuple[float, Path]]) -> Trajectory | None:
    """Read one pose file per frame, given with its time; a file that is not there is a pose not known."""
    return build_trajectory((t, checked_pose(str(path), read_matrix(path))) for t, path in timed if path.is_file())
