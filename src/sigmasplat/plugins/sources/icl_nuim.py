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

from sigmasplat.config import InputConfig
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.files.reading import exists
from sigmasplat.input.calibration import ICL_NUIM, TUM_UNITS_PER_METRE, freiburg_calibration, resolve_calibration
from sigmasplat.input.images import FRAMES_PER_SECOND
from sigmasplat.input.lists import parse_numbers, read_lines, read_poses
from sigmasplat.input.recorded import ImagePair, RecordedSource, first_size
from sigmasplat.registry import SourceFormat

LIST_NAMES = ("associations.txt", "association.txt", "associate.txt")
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def open_icl_nuim(folder: Path, settings: InputConfig) -> RecordedSource:
    """Open a folder. Raises SourceError if its list, images or ground-truth poses cannot be used."""
    path = _list_in(folder)
    if path is None:
        raise SourceError(
            f"{folder}: text depth is not supported; take the set's TUM-compatible PNGs (…_frei_png.tar.gz)"
        )
    images = _images(path)
    truth_path = next(iter(sorted(folder.glob("*.gt.freiburg"))), None)
    rendered = truth_path is not None or "frei_png" in folder.resolve().name
    recorded = ICL_NUIM if rendered else freiburg_calibration(folder)
    calibration = resolve_calibration(
        folder, recorded, first_size([i.color for i in images]), settings, TUM_UNITS_PER_METRE
    )
    truth = _truth(folder, truth_path)
    return RecordedSource(folder.resolve().name, images, calibration, settings, truth)


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


def _truth(folder: Path, path: Path | None) -> Trajectory | None:
    if path is not None:
        recorded = read_poses(path)
        return Trajectory(recorded.timestamps_s / FRAMES_PER_SECOND, MIRROR @ recorded.T_world_camera @ MIRROR)
    plain = folder / "groundtruth.txt"
    return read_poses(plain) if exists(plain) else None


def _list_in(folder: Path) -> Path | None:
    return next((folder / name for name in LIST_NAMES if (folder / name).is_file()), None)


PLUGIN = SourceFormat(
    "ICL-NUIM",
    "associations.txt",
    lambda path: _list_in(Path(path)) is not None or any(Path(path).glob("scene_*_0000.depth")),
    lambda path, settings: open_icl_nuim(Path(path), settings),
)
