"""Write paths with the covariance of each pose: as SQUARE text for `smfeval`, and in the order of ROS messages.

Both files have a header that names frames, order and units. Covariances are given as 6×6 matrices of the left twist
(ρ, φ) of T_world_camera, m² and rad². The covariance 0 of the first frame is written as `KNOWN`, because readers invert
covariances.
"""

from pathlib import Path

import numpy as np

from sigmasplat.data import se3
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.files.atomic import write_text
from sigmasplat.files.machine import package_version
from sigmasplat.run_folder.trajectory import COLUMNS, pose_line
from sigmasplat.types import Matrix

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
    A, covariance = se3.adjoint(se3.inverse(trajectory.T_world_camera)), _definite(covariance)
    rows, columns = np.tril_indices(6)
    header = [f"#%{key} {value}" for key, value in facts.items()] + [
        f"# {COLUMNS} c11 c21 c22 c31 … c66 (seconds, metres, camera to world; covariance in m, rad)",
        f"# {WORLD}",
    ]
    _write(path, header, trajectory, (A @ covariance @ np.swapaxes(A, 1, 2))[:, rows, columns])


def write_ros(path: Path, trajectory: Trajectory, covariance: Matrix) -> None:
    """Write TUM text with 36 more numbers per line: the covariance as in geometry_msgs/PoseWithCovariance.

    The matrix is row-major, in the order x, y, z, rotation about x, y, z; all axes are those of the world. Raises
    RunError if the file cannot be written.
    """
    J, covariance = se3.displacement(trajectory.T_world_camera), _definite(covariance)
    header = [
        f"# {COLUMNS} c11 c12 … c66 (seconds, metres, camera to world; covariance in m, rad)",
        "# covariance: 6×6, row-major, as in geometry_msgs/PoseWithCovariance: x, y, z, rotation about x, y, z",
        "# frame_id: world; the axes of position and rotation are those of the world, not of the camera",
        "# child_frame_id: camera (optical: x right, y down, z forward)",
        f"# {WORLD}",
    ]
    _write(path, header, trajectory, (J @ covariance @ np.swapaxes(J, 1, 2)).reshape(-1, 36))


def _definite(covariance: Matrix) -> Matrix:
    """Replace covariances [N, 6, 6] of 0 by `KNOWN`."""
    return np.where(np.any(covariance, (1, 2), keepdims=True), covariance, KNOWN)


def _write(path: Path, header: list[str], trajectory: Trajectory, numbers: Matrix) -> None:
    lines = [
        f"{pose_line(t, T)} " + " ".join(f"{value:.12g}" for value in row)
        for t, T, row in zip(trajectory.timestamps_s, trajectory.T_world_camera, numbers.tolist(), strict=True)
    ]
    write_text(path, "\n".join(header + lines) + "\n")
