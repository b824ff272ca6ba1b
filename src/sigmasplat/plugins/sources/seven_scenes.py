"""Read the 7-Scenes sequences as published: three files per frame, depth not registered to colour; and BundleFusion's
recordings, and ScanNet's by SensReader/c++, which have the same files, and the camera in info.txt or _info.txt.

seq-01/frame-000000.color.png  .depth.png  .pose.txt      (also .color.jpg); depth in mm, 0 and 65535 = no reading

The poses are those of the depth camera. By default colour is assumed to have the same camera, as in published results;
the error is up to some centimetres for near surfaces. With register_depth=on, depth is moved to the colour camera, and
the ground-truth path is converted: T_world_color = T_world_depth · T_depth_color.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

import sigmasplat.api as api
from sigmasplat.api import Camera, RecordedSource, se3

# 585, 320, 240 are the values of the 7-Scenes page. They belong to the depth camera, and so do the published poses. The
# colour camera and its position were fitted to the RedKitchen sequence by maximising the agreement of neighbouring
# images (andyzeng/tsdf-fusion-python, data/; the fit is in shared/data/redkitchen/calibration.json).
DEPTH_CAMERA = api.published("that of 7-Scenes", Camera(640, 480, 585.0, 585.0, 320.0, 240.0), api.MM_PER_METRE)
BOTH_CAMERAS = api.published(
    "that of 7-Scenes, both cameras", Camera(640, 480, 528.12, 528.12, 318.96, 232.91), api.MM_PER_METRE,
    depth_camera=DEPTH_CAMERA.camera,
    T_color_depth=np.array([
        [0.999969, -0.007635, 0.001694, -0.02421],
        [0.007625, 0.999954, 0.005732, 0.005946],
        [-0.001738, -0.005719, 0.999982, 0.006997],
        [0.0, 0.0, 0.0, 1.0],
    ]),
)  # fmt: skip


def open_seven_scenes(path: str, settings: api.InputConfig) -> RecordedSource:
    """Open the folder of a sequence. Raises SourceError if it cannot be used."""
    folder, files = Path(path), api.frame_files(Path(path))
    images, skipped = api.numbered_pairs(
        folder, files["color"], files["depth"], "frame-*.color.png", "frame-*.depth.png"
    )
    size = api.first_size([pair.color for pair in images.values()])
    known = api.intrinsics_beside(folder, settings, size, api.MM_PER_METRE)
    known = known or (BOTH_CAMERAS if settings.register_depth == "on" else DEPTH_CAMERA)
    calibration = api.resolve_calibration(folder, known, size, settings, api.MM_PER_METRE)
    calibration = replace(calibration, T_color_depth=se3.orthonormalise(calibration.T_color_depth))
    truth = api.read_pose_files((i.timestamp_s, files["pose"][n]) for n, i in images.items() if n in files["pose"])
    if truth and api.registers_depth(calibration, settings):
        truth = api.Trajectory(truth.timestamps_s, truth.T_world_camera @ se3.inverse(calibration.T_color_depth))
    source = RecordedSource(folder.resolve().name, [*images.values()], calibration, settings, truth, skipped)
    source.registrable = source.registrable or calibration.camera == DEPTH_CAMERA.camera
    return source


def open_bundlefusion(path: str, settings: api.InputConfig) -> RecordedSource:
    """Open a folder. Raises SourceError if images, camera or poses cannot be used."""
    folder, files = Path(path), api.frame_files(Path(path))
    images, skipped = api.numbered_pairs(folder, files["color"], files["depth"], "frame-*.color.*", "frame-*.depth.*")
    path_m = api.read_pose_files((i.timestamp_s, files["pose"][n]) for n, i in images.items() if n in files["pose"])
    return api.folder_source(
        folder, settings, [*images.values()], None, api.MM_PER_METRE, path_m, skipped, one_camera=True, estimated=True
    )  # fmt: skip


def _has_info(path: str) -> bool:
    return api.first_file(Path(path), ("_info.txt", "info.txt")) is not None and api.has_frame_files(Path(path))


def _recognises(path: str) -> bool:
    return api.has_frame_files(Path(path)) and not _has_info(path)


PLUGIN = (
    api.SourceFormat("7-Scenes", "frame-*.color.png", _recognises, open_seven_scenes, sensor="kinect-v1"),
    api.SourceFormat("BundleFusion", "frame-*.color.jpg and info.txt", _has_info, open_bundlefusion),
)
