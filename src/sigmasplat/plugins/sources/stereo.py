"""Read stereo pairs in lists as TUM's, and compute their depth.

rgb.txt right.txt [groundtruth.txt]   lines of "t path"; rgb/ is the left camera
calibration.json                      fx fy cx cy baseline_m, for a rectified pair; or distortion, right_camera (fx fy
                                      cx cy [distortion]) and T_right_left, 4 rows, for a pair that is rectified here

Depth belongs to the left image. It is computed from both images when a frame is read (`stereo_matching`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import (
    Calibration,
    ImagePair,
    InputConfig,
    RecordedSource,
    Size,
    SourceError,
    SourceFormat,
    Trajectory,
    first_size,
    pair_times,
    read_color,
    read_groundtruth,
    resolve_calibration,
)
from sigmasplat.plugins.sources.stereo_matching import (
    StereoCameras,
    StereoMatcher,
    StereoRectification,
    read_stereo_cameras,
    scene_scale,
)
from sigmasplat.plugins.sources.tum import read_list

Pair = tuple[float, Path, Path]


@dataclass(frozen=True, eq=False)
class StereoRig:
    """What turns two recorded images into colour and depth: size (width, height) of the recorded images, pixels."""

    size: Size
    rectification: StereoRectification
    matcher: StereoMatcher


@dataclass(frozen=True)
class StereoPair(ImagePair):
    """The left image (`color`) and the right image (`depth`) of one frame."""

    rig: StereoRig

    def read_color(self) -> NDArray[np.uint8]:
        """Read the left image, rectified, RGB [H, W, 3]. Raises SourceError naming the file."""
        return self.rig.rectification.left(self._read(self.color))

    def read_depth(self, units_per_metre: float) -> NDArray[np.float32]:
        """Match both images: depth of the left one in metres [H, W]. Raises SourceError naming the file."""
        return self.read(units_per_metre)[1]

    def read(self, units_per_metre: float) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
        """Read both images once: the left one, rectified, its depth and the standard deviation of depth, m."""
        left, right = self.read_color(), self.rig.rectification.right(self._read(self.depth))
        return left, *self.rig.matcher.depth_and_std_m(left, right)

    def _read(self, path: Path) -> NDArray[np.uint8]:
        image, (width, height) = read_color(path), self.rig.size
        if image.shape[:2] != (height, width):
            raise SourceError(
                f"{path} is {image.shape[1]}×{image.shape[0]} but the calibration is for {width}×{height}; "
                "take images of that size, or correct the calibration of the stereo pair"
            )
        return image


class StereoSource(RecordedSource):
    """A sequence of stereo pairs, with the depth of the left images."""

    computed_depth = True

    def __init__(
        self, name: str, pairs: Sequence[Pair], cameras: StereoCameras, settings: InputConfig,
        truth: Trajectory | None, skipped: Sequence[str] = (),
    ) -> None:  # fmt: skip
        """Prepare rectification and matching. `truth` is the path of the recorded left camera.

        Raises SourceError if the images do not match the calibration, or no frame has depth.
        """
        if settings.depth_scale:
            raise SourceError(f"{name}: input.depth_scale does not apply to a stereo pair; correct its baseline")
        rectification = StereoRectification.of(cameras)
        if rectification.baseline_m <= 0:
            raise SourceError(f"{name}: the second camera is not to the right of the first one; swap both")
        matcher = StereoMatcher(rectification.camera, rectification.baseline_m)
        rig = StereoRig((cameras.left.width, cameras.left.height), rectification, matcher)
        images = [StereoPair(*pair, rig) for pair in pairs]
        if truth is not None:
            truth = Trajectory(truth.timestamps_s, truth.T_world_camera @ rectification.T_left_rectified)
        super().__init__(name, images, Calibration(rectification.camera, 1.0), settings, truth, skipped)
        self.depth_noise_per_m = matcher.noise_per_m
        self.scene_scale = scene_scale(self.depth_of, len(self))


def open_stereo(place: str, settings: InputConfig) -> StereoSource:
    """Open a folder of stereo pairs. Raises SourceError if lists, images, calibration or poses cannot be used."""
    folder = Path(place)
    (left_s, lefts), (right_s, rights) = (read_list(folder / name) for name in ("rgb.txt", "right.txt"))
    indices, alone = pair_times(folder, {"left": left_s, "right": right_s})
    skipped = [f"{lefts[i]}: no right image" for i in alone]
    pairs = [(float(left_s[i]), lefts[i], rights[j]) for i, j in indices]
    size = first_size([left for _, left, _ in pairs])
    path = Path(settings.calibration or folder / "calibration.json")
    left = resolve_calibration(folder, None, size, settings, 1.0)
    if not path.is_file():
        raise SourceError(f"{folder}: the baseline of the stereo pair is unknown; write {path} with baseline_m, metres")
    cameras = read_stereo_cameras(path, replace(left, distortion=left.distortion if settings.undistort else None))
    return StereoSource(folder.resolve().name, pairs, cameras, settings, read_groundtruth(folder), skipped)


def _recognises(path: str) -> bool:
    folder = Path(path)
    with_depth = (folder / "depth.txt").is_file() or (folder / "depth").is_dir()
    return not with_depth and (folder / "rgb.txt").is_file() and (folder / "right.txt").is_file()


PLUGIN = SourceFormat("stereo pair", "rgb.txt and right.txt", _recognises, open_stereo, priority=2)
