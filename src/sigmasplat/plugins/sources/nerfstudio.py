"""Read a nerfstudio folder with depth or with stereo pairs: transforms.json whose frames name the images.

transforms.json        see `input/transforms.py`; depth_unit_scale_factor is metres per unit, default 0.001
images/…  depths/…     file_path and depth_file_path, relative to the folder, ordered by the numbers in the names

If depth has another size than colour (as on phones), both are assumed to share one camera. Stereo pairs without depth
are frames with right_file_path, and baseline_m at the top: a rectified pair; or pairs of frames whose paths differ in
"left" and "right", such as images/left/8.png: their poses give the baseline, and both images are rectified if they are
not parallel.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sigmasplat.api import (
    FRAMES_PER_SECOND,
    Calibration,
    Fields,
    ImagePair,
    InputConfig,
    Matrix,
    RecordedSource,
    SourceError,
    SourceFormat,
    build_trajectory,
    check_positive,
    first_size,
    folder_source,
    given_intrinsics,
    json_number,
    natural_key,
    read_frames,
    read_json_object,
    read_pose,
    read_transforms_camera,
    se3,
)
from sigmasplat.plugins.sources.stereo import StereoSource
from sigmasplat.plugins.sources.stereo_matching import StereoCameras

NAME = "transforms.json"
METRES_PER_UNIT = 0.001
"""nerfstudio's default of depth_unit_scale_factor."""


def open_nerfstudio(place: str, settings: InputConfig) -> RecordedSource:
    """Open a folder with depth. Raises SourceError if its JSON file, images or camera cannot be used."""
    folder, path = Path(place), Path(place) / NAME
    fields = read_json_object(path)
    named = sorted(read_frames(path, fields), key=lambda frame: natural_key(frame["file_path"]))
    frames = [frame for frame in named if isinstance(frame.get("depth_file_path"), str)]
    if not frames:
        raise SourceError(
            f'{path}: no frame has a "depth_file_path"; export depth with the images, see docs/data.md#without-depth'
        )
    skipped = [
        f"{path}: {frame['file_path']} has no depth_file_path"
        for frame in named
        if not isinstance(frame.get("depth_file_path"), str)
    ]
    images = [ImagePair(i / FRAMES_PER_SECOND, *_files(folder, frame)) for i, frame in enumerate(frames)]
    per_unit = json_number(path, fields, "depth_unit_scale_factor", METRES_PER_UNIT)
    units = round(1.0 / check_positive(path, "depth_unit_scale_factor", per_unit), 6)
    known = read_transforms_camera(path, fields, frames, first_size([i.color for i in images]), units)
    truth = build_trajectory((i.timestamp_s, read_pose(path, frame)) for i, frame in zip(images, frames, strict=True))
    return folder_source(folder, settings, images, known, units, truth, skipped, one_camera=True, estimated=True)


def _files(folder: Path, frame: Fields) -> tuple[Path, Path]:
    """Return the colour and the depth file of a frame; instant-ngp omits the file ending of colour."""
    color, depth = folder / frame["file_path"], folder / frame["depth_file_path"]
    bare = not color.suffix and not color.is_file()
    return (color.with_suffix(".png") if bare else color), depth


LEFT, RIGHT = "left", "right"
SAME_M, SAME_RAD = 0.002, 0.005
"""The pose of the right camera in the left one differs by less than this between two pairs."""


def open_stereo_transforms(place: str, settings: InputConfig) -> StereoSource:
    """Open a folder with stereo pairs. Raises SourceError if its JSON file, images or cameras cannot be used."""
    folder, path = Path(place), Path(place) / NAME
    fields = read_json_object(path)
    frames = sorted(read_frames(path, fields), key=lambda frame: natural_key(frame["file_path"]))
    pairs, alone = _pairs(frames)
    lefts = [left for left, _ in pairs]
    size = first_size([folder / left["file_path"] for left in lefts])
    left = _undistorted(read_transforms_camera(path, fields, lefts, size, 1.0), settings)
    right = _undistorted(read_transforms_camera(path, fields, [right for _, right in pairs], size, 1.0), settings)
    if lefts[0] is pairs[0][1]:  # one frame with two images
        T_right_left = np.eye(4)
        T_right_left[0, 3] = -check_positive(path, "baseline_m", json_number(path, fields, "baseline_m"))
        rights = [folder / frame["right_file_path"] for frame in lefts]
    else:
        T_right_left = _rig(path, pairs)
        rights = [folder / right["file_path"] for _, right in pairs]
    cameras = StereoCameras(
        given_intrinsics(left.camera, settings), right.camera, T_right_left, left.distortion, right.distortion
    )
    timed = [(i / FRAMES_PER_SECOND, folder / left["file_path"], rights[i]) for i, left in enumerate(lefts)]
    truth = build_trajectory((t, read_pose(path, left)) for (t, _, _), left in zip(timed, lefts, strict=True))
    skipped = [f"{path}: {name} has no right image" for name in alone]
    return StereoSource(folder.resolve().name, timed, cameras, settings, truth, skipped)


def _pairs(frames: Sequence[Fields]) -> tuple[list[tuple[Fields, Fields]], list[str]]:
    """Return left and right frames, and the names of the left ones without a right one; a frame that names both images
    is returned twice."""
    if any(isinstance(frame.get("right_file_path"), str) for frame in frames):
        both = [frame for frame in frames if isinstance(frame.get("right_file_path"), str)]
        alone = [frame["file_path"] for frame in frames if not isinstance(frame.get("right_file_path"), str)]
        return [(frame, frame) for frame in both], alone
    by_name = {frame["file_path"]: frame for frame in frames}
    lefts = [frame for frame in frames if LEFT in frame["file_path"]]
    found = [(frame, by_name.get(frame["file_path"].replace(LEFT, RIGHT))) for frame in lefts]
    return [(left, right) for left, right in found if right is not None], [
        left["file_path"] for left, right in found if right is None
    ]


def _rig(path: Path, pairs: Sequence[tuple[Fields, Fields]]) -> Matrix:
    """Return T_right_left [4, 4] of two cameras that move together. Raises SourceError if they do not."""
    found = []
    for left, right in pairs:
        T_world_left, T_world_right = read_pose(path, left), read_pose(path, right)
        if T_world_left is not None and T_world_right is not None:
            found.append(se3.inverse(T_world_right) @ T_world_left)
    if not found:
        raise SourceError(
            f"{path}: no pair has the poses of both cameras; write baseline_m and right_file_path instead"
        )
    for T in found[1:]:
        apart = se3.inverse(found[0]) @ T
        if np.linalg.norm(apart[:3, 3]) > SAME_M or se3.rotation_angle(apart[:3, :3]) > SAME_RAD:
            raise SourceError(
                f"{path}: the two cameras of the pairs move relative to each other, so they are no stereo pair; export "
                "depth with the images, see docs/data.md#without-depth"
            )
    return found[0]


def _undistorted(calibration: Calibration, settings: InputConfig) -> Calibration:
    return calibration if settings.undistort else replace(calibration, distortion=None)


def _is_stereo(path: str) -> bool:
    file = Path(path) / NAME
    if not file.is_file():
        return False
    try:
        frames: list[dict[str, Any]] = read_frames(file, read_json_object(file))
    except SourceError:
        return False  # the other format of this file reports it
    return not any("depth_file_path" in frame for frame in frames) and bool(_pairs(frames)[0])


PLUGIN = (
    SourceFormat("nerfstudio", NAME, lambda path: (Path(path) / NAME).is_file(), open_nerfstudio),
    SourceFormat(
        "nerfstudio stereo",
        "transforms.json with right_file_path, or with left and right frames",
        _is_stereo,
        open_stereo_transforms,
        priority=2,
    ),
)
