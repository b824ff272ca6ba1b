"""Write paths as KITTI odometry text: a pose per line, its upper 3×4 matrix row by row (metres, T_world_camera).

Layout: "poses" in the readme of the KITTI odometry benchmark's development kit. There are no times: line i is frame i.
"""

from pathlib import Path

from sigmasplat.io.atomic import write_text
from sigmasplat.model.trajectory import Trajectory


def write_poses(path: Path, trajectory: Trajectory) -> None:
    """Write T_world_camera with 12 significant digits. Raises RunError if not writable."""
    rows = (T[:3].ravel().tolist() for T in trajectory.T_world_camera)
    write_text(path, "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in rows))
