"""Change a sequence by what the user gives beside it: masks of pixels to ignore, and camera poses of other programs.

Masks: a folder with one image per frame, non-zero = ignore. Poses are used as they are, and no frame is tracked:

TUM text                 timestamp tx ty tz qx qy qz qw [id]        camera to world; frames are found by their times
tx ty tz qx qy qz qw     camera to world; one line per frame; TartanAir's pose_left.txt: x forward, y right, z down
KITTI text               12 or 16 numbers, a matrix by rows         camera to world; one line per frame
images.txt of COLMAP     number qw qx qy qz tx ty tz camera name    world to camera; frames are found by their names
transforms.json          frames with file_path, transform_matrix    nerfstudio; frames are found by their names
a folder                 0.txt, 1.txt, …: one matrix per frame      camera to world; not finite = no pose

Cameras look along z, with x to the right and y down; transforms.json has its own axes (`input/transforms.py`).
"""

import re
from dataclasses import replace
from pathlib import Path, PureWindowsPath

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.config import RECORDED_POSES
from sigmasplat.data import se3
from sigmasplat.data.camera_errors import CameraErrors
from sigmasplat.data.frame import Frame
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.files.reading import exists
from sigmasplat.input import lists
from sigmasplat.input.calibration import ASSUMED, Origin, read_json_object
from sigmasplat.input.images import COLOR_ENDINGS, image_size, list_images, read_values
from sigmasplat.input.lists import MAX_GAP_S, associate, checked_pose, read_lines
from sigmasplat.input.source import Source, Subset
from sigmasplat.input.transforms import read_frames, read_pose
from sigmasplat.types import Matrix

SAME_SHAPE = 0.02
"""Masks may have another size than the images, but the same ratio of width and height, within this share."""


class Corrected(Subset):
    """Another source without the errors of its stated camera. Raises SourceError for a live camera."""

    def __init__(self, whole: Source, errors: CameraErrors) -> None:
        refused = "camera_errors of input.calibrate are for recordings; remove them from its file"
        super().__init__(whole, refuse_live=refused)
        self._errors, self.camera = errors, errors.camera(whole.camera)

    def frame(self, i: int) -> Frame:
        return self._errors.frame(super().frame(i))

    def depth_of(self, i: int) -> NDArray[np.float32]:
        return self._errors.depth(super().depth_of(i))


class Masked(Subset):
    """Another source with a folder of masks, by the numbers in their names: ignored pixels have no depth, and their
    colour is not used.

    Raises SourceError if there is not one mask for each frame, one has another shape than the images, or the source is
    a live camera.
    """

    def __init__(self, whole: Source, folder: Path) -> None:
        refused = f"{folder}: masks are for recordings only; record the camera, then run the recording"
        super().__init__(whole, refuse_live=refused)
        self.origins = {name: origin for name, origin in self.origins.items() if name != "transparency"}
        if not folder.is_dir():
            raise SourceError(f"no such folder: {folder}; give the folder of the masks, one image for each frame")
        self._masks, c = list_images(folder, COLOR_ENDINGS), whole.camera
        if len(self._masks) != len(whole):
            found = f"found {len(self._masks)} masks for {len(whole)} frames"
            raise SourceError(f"{folder}: {found}; give one for each frame")
        for path in self._masks:
            width, height = image_size(path)
            if abs(width * c.height - height * c.width) > SAME_SHAPE * width * c.height:
                raise SourceError(
                    f"{path}: the mask is {width}×{height}, but the images are {c.width}×{c.height}; "
                    "make masks of the images' shape"
                )

    def frame(self, i: int) -> Frame:
        frame, ignored = super().frame(i), self._ignored(i)
        return replace(frame, depth_m=np.where(ignored, np.float32(0.0), frame.depth_m), ignored=ignored)

    def depth_of(self, i: int) -> NDArray[np.float32]:
        return np.where(self._ignored(i), np.float32(0.0), super().depth_of(i))

    def _ignored(self, i: int) -> NDArray[np.bool_]:
        """Return the pixels [H, W] of frame i that are ignored. Raises SourceError if its mask cannot be used."""
        values, c = read_values(self._masks[i], turned=True), self.camera
        chosen = values != 0 if values.ndim == 2 else (values[..., :3] != 0).any(-1)
        if chosen.shape != (c.height, c.width):
            chosen = np.asarray(Image.fromarray(chosen).resize((c.width, c.height), Image.Resampling.NEAREST))
        return np.asarray(chosen, np.bool_)


PLAIN_WORDS, TUM_WORDS, COLMAP_WORDS, MATRIX_WORDS = 7, (8, 9), 10, (12, 16)
TARTANAIR, T_FORWARD = re.compile(r"pose_(left|right|[lr]cam_\w+)\.txt"), np.eye(4)[[2, 0, 1, 3]]
"""Names of TartanAir's poses, and the transform to its axes (x forward, y right, z down) from ours."""
FORMATS = "give TUM or KITTI text, with no more columns, COLMAP's images.txt, transforms.json, or a folder of matrices"

GivenPoses = Trajectory | list[Matrix | None] | dict[str, Matrix]
"""Poses by time; for each frame in order, None = it has none; or by the name of the image file, without folder and
ending."""


def read_given_poses(path: Path) -> GivenPoses:
    """Read poses T_world_camera [4, 4] from a file or a folder. Raises SourceError that names the place and the remedy
    if it does not exist, has another format, or a pose is not rigid."""
    if not exists(path):
        raise SourceError(f"no such file or folder: {path}; {FORMATS}")
    if path.is_dir():
        paths = list_images(path, (".txt",))
        if not paths:
            raise SourceError(f"{path}: holds no .txt files with matrices; {FORMATS}")
        return [checked_pose(str(file), lists.read_matrix(file)) for file in paths]
    if path.suffix.lower() == ".json":
        return _named_poses(path)
    words = next((words for _, words in read_lines(path) if _is_number(words[0])), list[str]())
    if (count := len(words)) in TUM_WORDS:
        return lists.read_poses(path)
    if count == PLAIN_WORDS:
        lines = ((f"{path}:{line}", lists.parse_numbers(path, line, words)) for line, words in read_lines(path))
        T_axes = T_FORWARD if TARTANAIR.fullmatch(path.name) else np.eye(4)
        return [lists.rigid_transform(at, v[:3], [v[6], *v[3:6]]) @ T_axes for at, v in lines]
    if count in MATRIX_WORDS:
        rows = ((f"{path}:{line}", lists.parse_any_numbers(path, line, words)) for line, words in read_lines(path))
        return [checked_pose(where, lists.to_matrix(where, values)) for where, values in rows]
    if count >= COLMAP_WORDS and not _is_number(words[COLMAP_WORDS - 1]):
        return _colmap_poses(path)
    found = f"a line of {count} values" if words else "no poses"
    raise SourceError(f"{path}: poses of an unknown format ({found}); {FORMATS}")


def _colmap_poses(path: Path) -> dict[str, Matrix]:
    """Read the lines of images; each is followed by a line of points, which may be empty."""
    poses = dict[str, Matrix]()
    for line, words in read_lines(path):
        if len(words) < COLMAP_WORDS or _is_number(words[COLMAP_WORDS - 1]):
            continue
        qw, qx, qy, qz, x, y, z = lists.parse_numbers(path, line, words[1 : COLMAP_WORDS - 2])
        T_camera_world = lists.rigid_transform(f"{path}:{line}", [x, y, z], [qw, qx, qy, qz])
        poses[PureWindowsPath(" ".join(words[COLMAP_WORDS - 1 :])).stem] = se3.inverse(T_camera_world)
    return poses


def _named_poses(path: Path) -> dict[str, Matrix]:
    frames = read_frames(path, read_json_object(path))
    poses = {PureWindowsPath(f["file_path"]).stem: T for f in frames if (T := read_pose(path, f)) is not None}
    if not poses:
        raise SourceError(f'{path}: no frame has a "transform_matrix"; {FORMATS}')
    return poses


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


class Posed(Subset):
    """Another source with a pose for each frame; frames without one are left out.

    given: the path of the poses, or "recorded" for those that the device estimated itself; scale: factor from their
    unit to metres; depth_scale: factor from predicted depth, whose scale is arbitrary, to metres. Raises SourceError if
    the poses do not fit the frames, or the source is a live camera.
    """

    def __init__(self, whole: Source, given: str, scale: float = 1.0, depth_scale: float = 1.0) -> None:
        refused = f"{given}: poses are for recordings only; record the camera, then run the recording"
        super().__init__(whole, refuse_live=refused)
        found = _poses_of(whole, given)
        if given != RECORDED_POSES and not given.lower().endswith((".json", "images.txt")):
            axes = Origin("camera to world, x right, y down, z ahead", ASSUMED, "convert the file")
            self.origins = self.origins | {"poses": axes}
        self._depth_scale = np.float32(depth_scale if whole.predicted_depth else 1.0)
        self._poses = np.stack([T for T in found if T is not None])
        self._poses[:, :3, 3] *= scale
        self._indices = [i for i, T in enumerate(found) if T is not None]
        self.skipped += [f"{whole.name}, frame {i}: no pose in {given}" for i, T in enumerate(found) if T is None]

    def frame(self, i: int) -> Frame:
        frame = super().frame(i)
        depth_m = frame.depth_m if self._depth_scale == 1.0 else frame.depth_m * self._depth_scale
        return replace(frame, depth_m=depth_m, T_given_camera=self._poses[i])

    def depth_of(self, i: int) -> NDArray[np.float32]:
        return super().depth_of(i) * self._depth_scale


def _poses_of(whole: Source, given: str) -> list[Matrix | None]:
    poses = whole.device_path() if given == RECORDED_POSES else read_given_poses(Path(given))
    if poses is None:
        raise SourceError(
            f"{whole.name}: the recording has no poses that its device estimated; give a file of poses, or leave "
            "out input.poses: then poses are estimated"
        )
    if isinstance(poses, Trajectory):
        found, why = _by_time(whole, poses)
    elif isinstance(poses, list):
        found, why = poses, ": no pose is finite; give at least one finite pose"
        if len(poses) != len(whole):
            raise SourceError(
                f"{given}: found {len(poses)} poses for {len(whole)} frames; give one for each frame, in order"
            )
    else:
        found, why = _by_name(whole, poses)
    if all(T is None for T in found):
        raise SourceError(f"{given}{why}")
    return found


def _by_time(whole: Source, path: Trajectory) -> tuple[list[Matrix | None], str]:
    """Return the pose of each frame, and what is wrong if there is none; so does `_by_name`."""
    times_s = np.array([whole.timestamp_s(i) for i in range(len(whole))])
    rows = dict(associate(times_s, path.timestamps_s).tolist())
    return [path.T_world_camera[rows[i]] if i in rows else None for i in range(len(whole))], (
        f": no pose is within {MAX_GAP_S:g} s of a frame (poses {path.timestamps_s.min():.3f} … "
        f"{path.timestamps_s.max():.3f} s, frames {times_s.min():.3f} … {times_s.max():.3f} s); "
        "use the clock of the recording, in seconds"
    )


def _by_name(whole: Source, poses: dict[str, Matrix]) -> tuple[list[Matrix | None], str]:
    names = [Path(whole.image_name(i)).stem for i in range(len(whole))]
    has = f"images are named as {names[0]}" if names[0] else "the recording has no names of images"
    return [poses.get(name) for name in names], (
        f": no pose has the name of an image (poses are named as {next(iter(poses), 'nothing')}, {has}); "
        "use the names of the recording's colour images, or give TUM text"
    )
