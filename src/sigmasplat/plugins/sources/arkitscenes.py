"""Read scans of Apple's ARKitScenes (layout: its DATA.md), the parts named lowres of "raw" or "3dod".

lowres_wide/VIDEO_TIME.png  lowres_depth/VIDEO_TIME.png    colour and depth of one camera; time in s, depth in mm
confidence/VIDEO_TIME.png                      optional: readings with 0 are ignored
lowres_wide_intrinsics/VIDEO_TIME.pincam       width height fx fy cx cy, at times that may differ by 1 ms
lowres_wide.traj                               optional, by ARKit, ten per second: time, rotation vector, translation in
                                               m; world to camera
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import (
    MM_PER_METRE,
    Calibration,
    ImagePair,
    InputConfig,
    RecordedSource,
    SourceError,
    SourceFormat,
    Trajectory,
    folder_source,
    list_images,
    median_calibration,
    parse_numbers,
    read_lines,
    se3,
    times_of_names,
)
from sigmasplat.plugins.sources.plain import pairs_by_names


def open_arkitscenes(place: str, settings: InputConfig) -> RecordedSource:
    """Open the folder of a video. Raises SourceError if its images, intrinsics or path cannot be used."""
    folder = _frames(Path(place))
    colors, depths = (list_images(folder / part, (".png",)) for part in ("lowres_wide", "lowres_depth"))
    images, skipped, origins = pairs_by_names(folder, colors, depths, settings)
    images = [replace(image, confidence=folder / "confidence" / image.depth.name) for image in images]
    known, path = _calibration(folder / "lowres_wide_intrinsics", images), folder / "lowres_wide.traj"
    return folder_source(
        folder, settings, images, known, MM_PER_METRE, _path(path) if path.is_file() else None, skipped,
        one_camera=True, estimated="ARKit", origins=origins,
    )  # fmt: skip


def _calibration(folder: Path, images: list[ImagePair]) -> Calibration | None:
    """Return the median of the cameras that are nearest in time to the images, None without any."""
    if not (files := list_images(folder, (".pincam",))):
        return None
    times_s = times_of_names(files)[0]
    nearest = np.searchsorted((times_s[1:] + times_s[:-1]) / 2, [image.timestamp_s for image in images])
    cameras = np.concatenate([_numbers(files[i], 6) for i in nearest])
    width, height = cameras[0, :2].astype(int).tolist()
    return median_calibration(folder, (width, height), cameras[:, 2:], MM_PER_METRE)


def _path(file: Path) -> Trajectory:
    rows = _numbers(file, 7)
    T_camera_world = se3.exp_stack(np.concatenate([np.zeros_like(rows[:, 1:4]), rows[:, 1:4]], 1))
    T_camera_world[:, :3, 3] = rows[:, 4:]
    return Trajectory(rows[:, 0], se3.inverse(T_camera_world))


def _numbers(file: Path, count: int) -> NDArray[np.float64]:
    """Read lines of so many numbers [N, count]. Raises SourceError naming the file if there is none, or another."""
    rows = [parse_numbers(file, line, words) for line, words in read_lines(file)]
    if {len(row) for row in rows} != {count}:
        found = sorted({len(row) for row in rows})
        raise SourceError(f"{file}: expected lines of {count} numbers, found {found or 'none'}; download it again")
    return np.array(rows)


def _frames(folder: Path) -> Path:
    """Return the folder itself, or that of the frames in it, as 3dod has it: VIDEO/VIDEO_frames."""
    return next((inner.parent for inner in folder.glob("*_frames/lowres_wide")), folder)


PLUGIN = SourceFormat(
    "ARKitScenes", "lowres_wide/ and lowres_depth/",
    lambda path: all((_frames(Path(path)) / part).is_dir() for part in ("lowres_wide", "lowres_depth")),
    open_arkitscenes, sensor="lidar-iphone",
)  # fmt: skip
