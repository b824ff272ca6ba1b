"""Read stereo pairs, and compute their depth.

TUM-like   rgb.txt right.txt [groundtruth.txt] calibration.json   lines of "t path"; rgb/ is the left camera
           calibration.json: fx fy cx cy baseline_m, for a rectified pair; or distortion, right_camera (fx fy cx cy
           [distortion]) and T_right_left, 4 rows, for a pair that is rectified here
KITTI      image_2/ image_3/ (or image_0/ image_1/) calib.txt [times.txt] [poses.txt]   rectified, odometry benchmark
EuRoC      mav0/cam0 mav0/cam1: data.csv, sensor.yaml, data/*.png; state_groundtruth_estimate0/data.csv

Depth belongs to the left image. It is computed from both images when a frame is read (`stereo_matching`).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import (
    COLOR_ENDINGS,
    Calibration,
    Camera,
    ImagePair,
    InputConfig,
    Matrix,
    RecordedSource,
    Size,
    SourceError,
    SourceFormat,
    Trajectory,
    build_camera,
    build_trajectory,
    checked_pose,
    first_size,
    given_intrinsics,
    list_images,
    pair_times,
    parse_numbers,
    read_color,
    read_groundtruth,
    read_lines,
    read_text,
    resolve_calibration,
    rigid_transform,
    se3,
    to_matrix,
)
from sigmasplat.plugins.sources.stereo_matching import (
    StereoCameras,
    StereoMatcher,
    StereoRectification,
    read_stereo_cameras,
    scene_scale,
)
from sigmasplat.plugins.sources.tum import read_list

KITTI_PAIRS = (("image_2", "image_3"), ("image_0", "image_1"))
KITTI_FRAMES_PER_SECOND = 10.0
NANOSECONDS = 1e-9

Pair = tuple[float, Path, Path]
Timed = tuple[NDArray[np.float64], list[Path]]


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


def open_stereo(path: str, settings: InputConfig) -> StereoSource:
    """Open a folder of stereo pairs. Raises SourceError if lists, images, calibration or poses cannot be used."""
    folder = Path(path)
    if (folder / "right.txt").is_file():
        return _open_tum_like(folder, settings)
    root = _euroc_root(folder)
    return _open_euroc(folder, root, settings) if root else _open_kitti(folder, settings)


def _open_tum_like(folder: Path, settings: InputConfig) -> StereoSource:
    pairs, skipped = _timed_pairs(folder, *(read_list(folder / name) for name in ("rgb.txt", "right.txt")))
    size = first_size([left for _, left, _ in pairs])
    path = Path(settings.calibration or folder / "calibration.json")
    left = resolve_calibration(folder, None, size, settings, 1.0)
    if not path.is_file():
        raise SourceError(f"{folder}: the baseline of the stereo pair is unknown; write {path} with baseline_m, metres")
    cameras = read_stereo_cameras(path, replace(left, distortion=left.distortion if settings.undistort else None))
    return StereoSource(folder.resolve().name, pairs, cameras, settings, read_groundtruth(folder), skipped)


def _timed_pairs(folder: Path, left: Timed, right: Timed) -> tuple[list[Pair], list[str]]:
    indices, alone = pair_times(folder, {"left": left[0], "right": right[0]})
    skipped = [f"{left[1][i]}: no right image" for i in alone]
    return [(float(left[0][i]), left[1][i], right[1][j]) for i, j in indices], skipped


# ---- KITTI odometry ----


def _open_kitti(folder: Path, settings: InputConfig) -> StereoSource:
    names = _kitti_pair(folder)
    if names is None:
        raise SourceError(f"{folder}: no stereo pair (looked for right.txt, mav0/cam1, image_2 and image_3)")
    lefts, rights = (list_images(folder / name, COLOR_ENDINGS) for name in names)
    by_name = {path.stem: path for path in rights}
    times_s = _kitti_times_s(folder, len(lefts))
    both = [(t, left, by_name[left.stem]) for t, left in zip(times_s, lefts, strict=True) if left.stem in by_name]
    if not both:
        raise SourceError(f"{folder}: no image of {names[0]} has one of the same name in {names[1]}")
    skipped = [f"{left}: no right image" for left in lefts if left.stem not in by_name]
    size = first_size([left for _, left, _ in both])
    projections = _kitti_projections(folder / "calib.txt")
    for name in names:
        if f"P{name[-1]}" not in projections:
            raise SourceError(f"{folder / 'calib.txt'}: no projection P{name[-1]} of {name}; complete the file")
    P_left, P_right = (projections[f"P{name[-1]}"] for name in names)
    left = build_camera(folder / "calib.txt", *size, [float(P_left[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))])
    left = given_intrinsics(left, settings)
    T_right_left = np.eye(4)
    T_right_left[0, 3] = (P_right[0, 3] - P_left[0, 3]) / P_left[0, 0]
    truth = _kitti_truth(folder / "poses.txt", times_s, P_left[0, 3] / P_left[0, 0])
    stereo = StereoCameras(left, left, T_right_left)
    return StereoSource(folder.resolve().name, both, stereo, settings, truth, skipped)


def _kitti_pair(folder: Path) -> tuple[str, str] | None:
    return next((pair for pair in KITTI_PAIRS if all((folder / name).is_dir() for name in pair)), None)


def _kitti_times_s(folder: Path, count: int) -> list[float]:
    path = folder / "times.txt"
    if not path.is_file():
        return [i / KITTI_FRAMES_PER_SECOND for i in range(count)]
    times_s = [parse_numbers(path, line, words[:1])[0] for line, words in read_lines(path)]
    if len(times_s) != count:
        raise SourceError(f"{path}: {len(times_s)} times for {count} images; is the download complete?")
    return times_s


def _kitti_projections(path: Path) -> dict[str, Matrix]:
    """Read "P0: 12 numbers" lines as matrices [3, 4]. Raises SourceError naming file and line."""
    found = {}
    for line, words in read_lines(path):
        if re.fullmatch(r"P[0-3]:", words[0]):
            numbers = parse_numbers(path, line, words[1:])
            if len(numbers) != 12 or numbers[0] <= 0:
                raise SourceError(f"{path}:{line}: expected a projection of 12 numbers, found {len(numbers)}")
            found[words[0][:2]] = np.array(numbers).reshape(3, 4)
    return found


def _kitti_truth(path: Path, times_s: Sequence[float], x_m: float) -> Trajectory | None:
    """Read 12 numbers per line, the path of camera 0; `x_m` is the offset of the left camera from it (P[0, 3] / f)."""
    if not path.is_file():
        return None
    T_camera0_left = np.eye(4)
    T_camera0_left[0, 3] = -x_m
    timed = []
    for time_s, (line, words) in zip(times_s, read_lines(path), strict=False):
        where = f"{path}:{line}"
        T = checked_pose(where, to_matrix(where, parse_numbers(path, line, words)))
        timed.append((time_s, None if T is None else T @ T_camera0_left))
    return build_trajectory(timed)


# ---- EuRoC ----


def _euroc_root(folder: Path) -> Path | None:
    for root in (folder / "mav0", folder):
        if all((root / name / "sensor.yaml").is_file() for name in ("cam0", "cam1")):
            return root
    return None


def _open_euroc(folder: Path, root: Path, settings: InputConfig) -> StereoSource:
    pairs, skipped = _timed_pairs(folder, *(_euroc_list(root / name) for name in ("cam0", "cam1")))
    sensors = [_euroc_sensor(root / name / "sensor.yaml") for name in ("cam0", "cam1")]
    (left, left_lens, T_body_left), (right, right_lens, T_body_right) = sensors
    cameras = StereoCameras(
        given_intrinsics(left, settings), right, se3.inverse(T_body_right) @ T_body_left, left_lens, right_lens
    )
    path = root / "state_groundtruth_estimate0" / "data.csv"
    truth = None
    if path.is_file():
        timed = []
        for line, words in read_lines(path):
            t, *values = parse_numbers(path, line, words[:8])
            T = rigid_transform(f"{path}:{line}", values[:3], values[3:])
            timed.append((t * NANOSECONDS, T @ T_body_left))
        truth = build_trajectory(timed)
    return StereoSource(folder.resolve().name, pairs, cameras, settings, truth, skipped)


def _euroc_list(camera: Path) -> Timed:
    times_s, paths = [], []
    for line, words in read_lines(camera / "data.csv"):
        times_s.append(parse_numbers(camera / "data.csv", line, words[:1])[0] * NANOSECONDS)
        paths.append(camera / "data" / words[-1])
    return np.array(times_s), paths


def _euroc_sensor(path: Path) -> tuple[Camera, tuple[float, ...], Matrix]:
    text = read_text(path)

    def found(pattern: str) -> list[float]:
        block = re.search(rf"{pattern}\[([^\]]*)\]", text, re.MULTILINE)
        return parse_numbers(path, 1, block.group(1).replace(",", " ").split()) if block else []

    def numbers(key: str, count: int) -> list[float]:
        values = found(rf"^\s*{key}:[^\[]*")
        if len(values) != count:
            raise SourceError(f'{path}: field "{key}" needs {count} numbers, found {len(values)}')
        return values

    lens = re.search(r"^distortion_model:\s*([\w-]+)", text, re.MULTILINE)
    if lens and lens.group(1) not in ("radial-tangential", "plumb_bob"):
        raise SourceError(f"{path}: distortion_model is {lens.group(1)}, only radial-tangential is supported")
    width, height = (int(value) for value in numbers("resolution", 2))
    values = found(r"T_BS:[\s\S]*?data:\s*")
    T = np.array(values).reshape(4, 4) if len(values) == 16 else np.zeros((4, 4))
    if not se3.is_rigid(T):
        raise SourceError(f'{path}: field "T_BS" is not a rigid 4×4 matrix')
    k1, k2, p1, p2 = numbers("distortion_coefficients", 4)
    return build_camera(path, width, height, numbers("intrinsics", 4)), (k1, k2, p1, p2, 0.0), se3.orthonormalise(T)


def _recognises(path: str) -> bool:
    folder = Path(path)
    if (folder / "depth.txt").is_file() or (folder / "depth").is_dir():
        return False
    if (folder / "rgb.txt").is_file() and (folder / "right.txt").is_file():
        return True
    kitti = (folder / "calib.txt").is_file() and _kitti_pair(folder) is not None
    return kitti or _euroc_root(folder) is not None


PLUGIN = SourceFormat(
    "stereo pair",
    "rgb.txt and right.txt, image_2/ and image_3/ with calib.txt, or mav0/cam0 and mav0/cam1",
    _recognises,
    open_stereo,
    priority=2,
)
