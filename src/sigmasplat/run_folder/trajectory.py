"""Write paths as TUM text, one pose per line: `t tx ty tz qx qy qz qw` (seconds, metres, T_world_camera).

Paths with the covariance of each pose have a header that names frames, order and units. Covariances are given as 6×6
matrices of the left twist (ρ, φ) of T_world_camera, m² and rad². The covariance 0 of the first frame is written as
`KNOWN`, because readers invert covariances.
"""

from pathlib import Path

import numpy as np

from sigmasplat.data import se3
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.files.atomic import write_text
from sigmasplat.files.machine import package_version
from sigmasplat.types import Matrix

COLUMNS = "t tx ty tz qx qy qz qw"


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write T_world_camera as TUM text with nanoseconds and 12 significant digits.

    Raises RunError if the file cannot be written.
    """
    lines = map(pose_line, trajectory.timestamps_s, trajectory.T_world_camera)
    write_text(path, "\n".join([f"# {COLUMNS} (seconds, metres, camera to world)", *lines]) + "\n")


def pose_line(t: float, T: Matrix) -> str:
    """Return a pose [4, 4] at a time, seconds, as a line of TUM text."""
    w, x, y, z = se3.quaternion_from_rotation(T[:3, :3])
    return f"{t:.9f} " + " ".join(f"{value:.12g}" for value in (*T[:3, 3], x, y, z, w))


WORLD = (
    "world = camera of the first frame, whose pose is known (written as 0.01 mm, 0.01 mrad); "
    "axes x right, y down, z forward"
)
KNOWN = 1e-10 * np.eye(6)
"""Covariance written for a pose that is known exactly: standard deviations of 10 µm and 10 µrad, far below any error of
a path. `smfeval validate --strict` takes variances below 1e-12 for mistakes."""


def write_square(path: Path, trajectory: Trajectory, covariance: Matrix) -> None:
    """Write TUM text with 21 more numbers per line: the lower triangle, row by row, of the covariance [N, 6, 6] in the
    camera's axes (right perturbation: T_true = T exp(ξ), translation first).

    The header is that of SQUARE 0.3, the format of `smfeval`; TUM readers take it for comments. Raises RunError if the
    file cannot be written.
    """
    facts = {
        "FORMAT": "SQUARE/0.3", "REPRESENTATION": "gaussian_se3", "POSE_FRAME": "world", "BODY_FRAME": "camera",
        "GAUGE": "se3", "TIMESTAMP_UNIT": "seconds", "ALGORITHM": "sigmasplat", "ALGORITHM_VERSION": package_version(),
        "TANGENT_CONVENTION": "right_perturbation", "TANGENT_ORDER": "translation_rotation",
        "ROTATION_PARAM": "axis_angle",
    }  # fmt: skip
    A = se3.adjoint(se3.inverse(trajectory.T_world_camera))
    covariance = np.where(np.any(covariance, (1, 2), keepdims=True), covariance, KNOWN)
    rows, columns = np.tril_indices(6)
    header = [f"#%{key} {value}" for key, value in facts.items()] + [
        f"# {COLUMNS} c11 c21 c22 c31 … c66 (seconds, metres, camera to world; covariance in m, rad)",
        f"# {WORLD}",
    ]
    numbers = (A @ covariance @ np.swapaxes(A, 1, 2))[:, rows, columns]
    lines = [
        f"{pose_line(t, T)} " + " ".join(f"{value:.12g}" for value in row)
        for t, T, row in zip(trajectory.timestamps_s, trajectory.T_world_camera, numbers.tolist(), strict=True)
    ]
    write_text(path, "\n".join(header + lines) + "\n")
