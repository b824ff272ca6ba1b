"""Read camera poses that the user gives, in the formats of other programs.

TUM text                 timestamp tx ty tz qx qy qz qw             camera to world; frames are found by their times
KITTI text               12 or 16 numbers, a matrix by rows         camera to world; one line per frame
images.txt of COLMAP     number qw qx qy qz tx ty tz camera name    world to camera; frames are found by their names
transforms.json          frames with file_path, transform_matrix    nerfstudio; frames are found by their names
a folder                 0.txt, 1.txt, …: one matrix per frame      camera to world; not finite = no pose

Cameras look along z, with x to the right and y down; transforms.json has its own axes (`files/transforms.py`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sigmasplat.data import se3
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.files.reading import exists
from sigmasplat.input.calibration import read_json_object
from sigmasplat.input.folders import list_images
from sigmasplat.input.lists import parse_numbers, read_lines, read_poses
from sigmasplat.input.pose_files import checked_pose, read_matrix, rigid_transform, to_matrix
from sigmasplat.input.transforms import read_frames, read_pose
from sigmasplat.types import Matrix

TUM_WORDS, COLMAP_WORDS, MATRIX_WORDS = 8, 10, (12, 16)
FORMATS = "give TUM or KITTI text, images.txt of COLMAP, transforms.json, or a folder with one matrix per frame"


@dataclass(frozen=True, eq=False)
class ByNumber:
    """A pose for each frame in order; None = it has none."""

    poses: Sequence[Matrix | None]


@dataclass(frozen=True, eq=False)
class ByName:
    """Poses by the name of the image file, without folder and ending."""

    poses: Mapping[str, Matrix]


GivenPoses = Trajectory | ByNumber | ByName


def read_given_poses(path: Path) -> GivenPoses:
    """Read poses T_world_camera [4, 4] from a file or a folder. Raises SourceError that names the place and the remedy
    if it does not exist, has another format, or a pose is not rigid."""
    if not exists(path):
        raise SourceError(f"no such file or folder: {path}; {FORMATS}")
    if path.is_dir():
        return _folder(path)
    if path.suffix.lower() == ".json":
        return _transforms(path)
    first = next(read_lines(path), None)
    words = [] if first is None else first[1]
    if len(words) == TUM_WORDS:
        return read_poses(path)
    if len(words) in MATRIX_WORDS:
        return ByNumber([_matrix(path, line, words) for line, words in read_lines(path)])
    if len(words) >= COLMAP_WORDS and not _is_number(words[COLMAP_WORDS - 1]):
        return _colmap(path)
    found = f"a line of {len(words)} values" if words else "no poses"
    raise SourceError(f"{path}: poses of an unknown format ({found}); {FORMATS}")


def _matrix(path: Path, line: int, words: list[str]) -> Matrix | None:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise SourceError(f"{path}:{line}: expected numbers, found {' '.join(words)[:60]!r}") from error
    where = f"{path}:{line}"
    return checked_pose(where, to_matrix(where, values))


def _folder(folder: Path) -> ByNumber:
    paths = list_images(folder, (".txt",))
    if not paths:
        raise SourceError(f"{folder}: holds no .txt files with matrices; {FORMATS}")
    return ByNumber([checked_pose(str(path), read_matrix(path)) for path in paths])


def _colmap(path: Path) -> ByName:
    """Read the lines of images; each is followed by a line of points, which may be empty."""
    poses = dict[str, Matrix]()
    for line, words in read_lines(path):
        if len(words) < COLMAP_WORDS or _is_number(words[COLMAP_WORDS - 1]):
            continue
        qw, qx, qy, qz, x, y, z = parse_numbers(path, line, words[1 : COLMAP_WORDS - 2])
        T_camera_world = rigid_transform(f"{path}:{line}", [x, y, z], [qw, qx, qy, qz])
        poses[Path(" ".join(words[COLMAP_WORDS - 1 :])).stem] = se3.inverse(T_camera_world)
    return ByName(poses)


def _transforms(path: Path) -> ByName:
    found = {
        Path(frame["file_path"]).stem: read_pose(path, frame) for frame in read_frames(path, read_json_object(path))
    }
    poses = {name: T for name, T in found.items() if T is not None}
    if not poses:
        raise SourceError(f'{path}: no frame has a "transform_matrix"; {FORMATS}')
    return ByName(poses)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
