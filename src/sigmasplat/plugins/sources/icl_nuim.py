"""Read ICL-NUIM's TUM-compatible sequences, and other folders with an association file.

rgb/0.png  depth/0.png  associations.txt     lines "number depth/0.png number rgb/0.png", depth first; depth · 5000
livingRoom0.gt.freiburg, traj0.gt.freiburg   lines "number tx ty tz qx qy qz qw", the image's number

The scenes were rendered with a camera whose y axis points up, in a left-handed world: hence fy = −480 in the published
K. The PNG images are stored upright, so fy = +480 for a camera with y down. The ground-truth path is still in the
mirrored world. With F = diag(1, −1, 1, 1), T_ours = F · T · F is its reflection about the xz plane, a rigid motion
(nvidia-isaac/cuVSLAM converts it in the same way, and its scores confirm it).
"""

from pathlib import Path

import numpy as np

from sigmasplat.api import (
    FRAMES_PER_SECOND,
    TUM_UNITS_PER_METRE,
    Calibration,
    Camera,
    ImagePair,
    InputConfig,
    RecordedSource,
    SourceError,
    SourceFormat,
    Trajectory,
    first_file,
    folder_source,
    freiburg_calibration,
    parse_numbers,
    read_groundtruth,
    read_lines,
    read_poses,
)

CAMERA = Calibration(Camera(640, 480, 481.2, 480.0, 319.5, 239.5), TUM_UNITS_PER_METRE)
LIST_NAMES = ("associations.txt", "association.txt", "associate.txt")
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def open_icl_nuim(path: str, settings: InputConfig) -> RecordedSource:
    """Open a folder. Raises SourceError if its list, images or ground-truth poses cannot be used."""
    folder = Path(path)
    listed = first_file(folder, LIST_NAMES)
    if listed is None:
        raise SourceError(
            f"{folder}: text depth is not supported; take the set's TUM-compatible PNGs (…_frei_png.tar.gz)"
        )
    images = _images(listed)
    mirrored = next(iter(sorted(folder.glob("*.gt.freiburg"))), None)
    rendered = mirrored is not None or "frei_png" in folder.resolve().name
    known = CAMERA if rendered else freiburg_calibration(folder)
    truth = read_poses(mirrored) if mirrored else read_groundtruth(folder)
    if mirrored and truth:
        truth = Trajectory(truth.timestamps_s / FRAMES_PER_SECOND, MIRROR @ truth.T_world_camera @ MIRROR)
    return folder_source(folder, settings, images, known, TUM_UNITS_PER_METRE, truth)


def _images(path: Path) -> list[ImagePair]:
    """Read the list; the path with "depth" in it is the depth image."""
    images = []
    for line, words in read_lines(path):
        if len(words) != 4 or ("depth" in words[1]) == ("depth" in words[3]):
            raise SourceError(
                f"{path}:{line}: expected 'time depth/image time rgb/image', found {' '.join(words)[:60]!r}"
            )
        times = parse_numbers(path, line, [words[0], words[2]])
        color, depth = (3, 1) if "depth" in words[1] else (1, 3)
        images.append(ImagePair(times[color // 2], path.parent / words[color], path.parent / words[depth]))
    if not images:
        raise SourceError(f"{path}: lists no images")
    if all(image.timestamp_s.is_integer() for image in images):  # frame numbers, not seconds
        images = [ImagePair(i.timestamp_s / FRAMES_PER_SECOND, i.color, i.depth) for i in images]
    return sorted(images, key=lambda image: image.timestamp_s)


def _recognises(path: str) -> bool:
    return first_file(Path(path), LIST_NAMES) is not None or any(Path(path).glob("scene_*_0000.depth"))


PLUGIN = SourceFormat("ICL-NUIM", "associations.txt", _recognises, open_icl_nuim)
