"""Read the Bonn RGB-D Dynamic Dataset: TUM's lists, another camera, and ground truth of the motion-capture markers.

rgbd_bonn_NAME/rgb.txt  depth.txt  groundtruth.txt  rgb/  depth/        recognised by `bonn` in the folder's path

The data set's page publishes the intrinsics, and how to convert the motion-capture poses T to camera poses:
T_world_camera = T_ROS · T · T_ROS · T_m (used there for the first pose of a run, to align a model with the laser scan).
The published T_m is not rigid: its axes have length 1.059. Here its rotation is orthonormalised, its offset unchanged.
"""

from pathlib import Path

import numpy as np

from sigmasplat.config import InputConfig
from sigmasplat.data import se3
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.input.calibration import BONN
from sigmasplat.input.recorded import RecordedSource
from sigmasplat.plugins.sources.tum import open_tum
from sigmasplat.registry import SourceFormat

T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
T_MARKERS_CAMERA = se3.orthonormalise(
    np.array(
        [
            [1.0157, 0.1828, -0.2389, 0.0113],
            [0.0009, -0.8431, -0.6413, -0.0098],
            [-0.3009, 0.6147, -0.8085, 0.0111],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
)


def camera_trajectory(markers: Trajectory) -> Trajectory:
    """Convert the recorded path of the markers to the path of the camera."""
    return Trajectory(markers.timestamps_s, T_ROS @ markers.T_world_camera @ T_ROS @ T_MARKERS_CAMERA)


def open_bonn(folder: Path, settings: InputConfig) -> RecordedSource:
    """Open a folder. Raises SourceError as `open_tum`."""
    return open_tum(folder, settings, camera=BONN, camera_path=camera_trajectory)


def recognises(path: str) -> bool:
    """Return whether it is a TUM folder whose path contains "bonn"."""
    folder = Path(path)
    lists = (folder / "rgb.txt").is_file() or (folder / "depth.txt").is_file()
    return lists and any("bonn" in part.lower() for part in folder.resolve().parts[-3:])


PLUGIN = SourceFormat(
    "Bonn dynamic",
    "TUM's lists under rgbd_bonn_…",
    recognises,
    lambda path, settings: open_bonn(Path(path), settings),
    priority=2,
    sensor="kinect-v1",
)
