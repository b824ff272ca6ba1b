"""Read the 7-Scenes sequences as published: three files per frame, depth not registered to colour.

seq-01/frame-000000.color.png  .depth.png  .pose.txt      (also .color.jpg); depth in mm, 0 and 65535 = no reading
SCENE/seq-01/ seq-02/ …                                   the scene's folder, if it holds one sequence

The poses are those of the depth camera. By default colour is assumed to have the same camera, as in published results;
the error is up to some centimetres for near surfaces. With register_depth=on, depth is moved to the colour camera, and
the ground-truth path is converted: T_world_color = T_world_depth · T_depth_color.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

import sigmasplat.api as api
from sigmasplat.api import Camera, RecordedSource, SourceError, se3

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
    """Open the folder of a sequence, or of a scene with one sequence. Raises SourceError if it cannot be used."""
    folder = Path(path) if api.has_frame_files(Path(path)) else _only_sequence(Path(path))
    files = api.frame_files(folder)
    images, skipped = api.numbered_pairs(
        folder, files["color"], files["depth"], "frame-*.color.png", "frame-*.depth.png"
    )
    known = BOTH_CAMERAS if settings.register_depth == "on" else DEPTH_CAMERA
    size = api.first_size([pair.color for pair in images.values()])
    calibration = api.resolve_calibration(folder, known, size, settings, api.MM_PER_METRE)
    calibration = replace(calibration, T_color_depth=se3.orthonormalise(calibration.T_color_depth))
    truth = api.read_pose_files((i.timestamp_s, files["pose"][n]) for n, i in images.items() if n in files["pose"])
    if truth and api.registers_depth(calibration, settings):
        truth = api.Trajectory(truth.timestamps_s, truth.T_world_camera @ se3.inverse(calibration.T_color_depth))
    source = RecordedSource(folder.resolve().name, [*images.values()], calibration, settings, truth, skipped)
    source.registrable = source.registrable or calibration.camera == DEPTH_CAMERA.camera
    return source


def _only_sequence(scene: Path) -> Path:
    sequences = [path for path in sorted(scene.glob("seq-*")) if path.is_dir() and api.has_frame_files(path)]
    packed = [path.name for path in sorted(scene.glob("seq-*.zip"))]
    if not sequences and packed:
        raise SourceError(f"{scene}: the sequences are not unpacked ({', '.join(packed[:3])}); unzip them first")
    if len(sequences) != 1:
        names = ", ".join(path.name for path in sequences)
        raise SourceError(f"{scene} holds {len(sequences)} sequences ({names}); give one, for example {sequences[0]}")
    return sequences[0]


def _recognises(path: str) -> bool:
    folder = Path(path)
    if api.has_frame_files(folder):
        return not any((folder / name).is_file() for name in ("_info.txt", "info.txt"))
    return any(api.has_frame_files(entry) or entry.suffix == ".zip" for entry in folder.glob("seq-*"))


PLUGIN = api.SourceFormat("7-Scenes", "frame-*.color.png", _recognises, open_seven_scenes, sensor="kinect-v1")
