"""Read and record sequences in the layout of the TUM RGB-D benchmark; read the Bonn RGB-D Dynamic Dataset, ICL-NUIM's
TUM-compatible sequences, and other folders with an association file.

rgb.txt  depth.txt  groundtruth.txt     lines of "t path" or "t tx ty tz qx qy qz qw", comments after #
calibration.json                        optional: fx fy cx cy width height depth_scale [distortion]
trans_matrix.yaml                       OpenLORIS's: transforms from the robot's base, whose poses are the truth
gyroscope.txt                           optional: "t wx wy wz", rad/s about the camera's x, y, z (right, down, forward)

Bonn (recognised by `bonn` in the folder's path) has the same lists, another camera, and ground truth of the motion
capture's markers. Its page publishes the intrinsics, and how to convert the motion-capture poses T to camera poses:
T_world_camera = T_ROS · T · T_ROS · T_m (used there for the first pose of a run, to align a model with the laser scan).
The published T_m is not rigid: its axes have length 1.059. Here its rotation is orthonormalised, its offset unchanged.

ICL-NUIM, and any folder with such a list:

rgb/0.png  depth/0.png  associations.txt     lines "number depth/0.png number rgb/0.png", depth first; depth · 5000
livingRoom0.gt.freiburg, traj0.gt.freiburg   lines "number tx ty tz qx qy qz qw", the image's number

The scenes were rendered with a camera whose y axis points up, in a left-handed world: hence fy = −480 in the published
K. The PNG images are stored upright, so fy = +480 for a camera with y down. The ground-truth path is still in the
mirrored world. With F = diag(1, −1, 1, 1), T_ours = F · T · F is its reflection about the xz plane, a rigid motion
(nvidia-isaac/cuVSLAM converts it in the same way, and its scores confirm it).
"""

import json
import re
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import sigmasplat.api as api
from sigmasplat.api import Camera, Gyroscope, ImagePair, InputConfig, Origin, RunError, SourceError, SourceFormat, se3
from sigmasplat.plugins.sources.bag_cameras import chained

COLOR_LISTS, DEPTH_LISTS = ("rgb.txt", "color.txt"), ("aligned_depth.txt", "depth.txt")
"""The second name of colour, and the first of depth, are OpenLORIS's, whose depth is in millimetres."""
MOTION_CAPTURE = 0.004, float(np.deg2rad(0.3))
"""Errors of a true pose, rms, m and rad: on fr1/xyz calibrated paths differ from the truth by 5 to 6 mm, √2 times as
much, whatever the time between two poses."""


def open_tum(path: str, settings: InputConfig, bonn: bool = False) -> api.RecordedSource:
    """Open a folder; bonn: whether it has the camera and the markers' path of the Bonn data set. Raises SourceError if
    its lists, images, calibration, ground-truth poses or gyroscope cannot be used."""
    folder = Path(path)
    colors_of = api.first_file(folder, COLOR_LISTS) or folder / COLOR_LISTS[0]
    color_s, colors = read_list(colors_of)
    depth_s, depths = _depth_list(folder)
    depth_s -= settings.depth_delay_s
    pairs, alone = api.pair_times(folder, {colors_of.name: color_s, "depth.txt": depth_s}, settings)
    images = [
        ImagePair(float(color_s[i]), colors[i], depths[j], depth_late_s=float(depth_s[j] - color_s[i]))
        for i, j in pairs
    ]
    gaps_s = np.abs(api.nearest_gaps_s(color_s, depth_s))
    skipped = [
        f"{colors[i]}: no depth within {settings.max_gap_s:g} s, nearest {gaps_s[i]:.3f} s away"
        + " (used by another image)" * bool(gaps_s[i] < settings.max_gap_s)
        for i in alone
    ]
    truth = _of_color(folder, api.read_groundtruth(folder))
    if bonn and truth:
        truth = api.Trajectory(truth.timestamps_s, T_ROS @ truth.T_world_camera @ T_ROS @ T_MARKERS_CAMERA)
    known = BONN if bonn else api.freiburg_calibration(folder)
    truth = replace(truth, error_rms=MOTION_CAPTURE) if truth and known else truth
    gyroscope = read_gyroscope(folder / "gyroscope.txt") if api.exists(folder / "gyroscope.txt") else None
    units = api.TUM_UNITS_PER_METRE if colors_of.name == COLOR_LISTS[0] else api.MM_PER_METRE
    return api.folder_source(
        folder, settings, images, known, units, truth, skipped, gyroscope=gyroscope,
        origins=api.time_origins(settings, "by time", "read from their lists"),
    )  # fmt: skip


def _of_color(folder: Path, truth: api.Trajectory | None) -> api.Trajectory | None:
    """Return the path of OpenLORIS's colour camera, given that of the robot's base; others as they are."""
    path, edges = folder / "trans_matrix.yaml", dict[str, dict[str, api.Matrix]]()
    if truth is None or not path.is_file():
        return truth
    pattern = r"(?s)parent_frame:\s*(\S+)\s+child_frame:\s*(\S+).*?data:\s*\[([^]]*)"
    for parent, child, numbers in re.findall(pattern, api.read_text(path)):
        T = api.to_matrix(f"{path}: {child}", [float(number) for number in numbers.split(",")])
        edges.setdefault(parent, {})[child], edges.setdefault(child, {})[parent] = T, se3.inverse(T)
    if (T_base_color := chained(edges, "base_link", "d400_color_optical_frame")) is None:
        raise SourceError(f"{path}: no transform from base_link to d400_color_optical_frame; copy it again")
    return api.Trajectory(truth.timestamps_s, truth.T_world_camera @ T_base_color)


def _depth_list(folder: Path) -> tuple[NDArray[np.float64], list[Path]]:
    path, looked_for, remedy = api.first_file(folder, DEPTH_LISTS) or folder / "depth.txt", "depth.txt", ""
    if path.is_file():
        times_s, paths = read_list(path)
        if any(p.is_file() for p in paths):
            return times_s, paths
        looked_for = f"the {len(paths)} files of {path.name}, first {paths[0]}"
        remedy = "correct its paths" if any((folder / "depth").glob("*.*")) else ""
    remedy = remedy or "is this the RGB-only download? see docs/data.md#without-depth"
    raise SourceError(f"no depth images in {folder} (looked for {looked_for}); {remedy}")


def read_list(path: Path) -> tuple[NDArray[np.float64], list[Path]]:
    """Read "t path" lines: timestamps [N] seconds and image paths. Raises SourceError naming file and line."""
    lines = list(api.read_listed(path, "timestamp path"))
    return api.dated_seconds(np.array([t for (t,), _ in lines])), [file for _, (file,) in lines]


def read_gyroscope(path: Path) -> Gyroscope:
    """Read "t wx wy wz" lines, seconds and rad/s in camera axes. Raises SourceError naming the file, and the line if
    it has other values or no later time than the line before."""
    rows: list[list[float]] = []
    for line, words in api.read_lines(path):
        if len(words) != 4:
            raise SourceError(f"{path}:{line}: expected 't wx wy wz', found {len(words)} values")
        rows.append(api.parse_numbers(path, line, words))
        if len(rows) > 1 and rows[-1][0] <= rows[-2][0]:
            raise SourceError(f"{path}:{line}: time {words[0]} is not after that of the line before; sort the lines")
    if len(rows) < 2:
        raise SourceError(f"{path}: holds {len(rows)} measurements; delete it or add measurements")
    values = np.array(rows)
    try:
        return Gyroscope(values[:, 0], values[:, 1:])
    except SourceError as error:
        raise SourceError(f"{path}: {error}") from error


HEAD = "# timestamp path\n"


class TumWriter:
    """Writes frames to a new TUM folder: both images first, then a line in each list.

    Depth has steps of 1/5000 m; readings above 13.1 m do not fit 16 bits and become 0 (no reading).
    """

    def __init__(self, folder: Path, camera: Camera) -> None:
        """Create the folder and calibration.json. Raises RunError if it holds a sequence or cannot be written."""
        self.folder = folder
        if (folder / "rgb.txt").exists():
            raise RunError(f"{folder} already holds a sequence (rgb.txt); give another folder")
        with self._writing():
            for part in ("rgb", "depth"):
                (folder / part).mkdir(parents=True, exist_ok=True)
            calibration = asdict(camera) | {"depth_scale": api.TUM_UNITS_PER_METRE}
            (folder / "calibration.json").write_text(json.dumps(calibration, indent=1) + "\n")

    def add(self, frame: api.Frame) -> None:
        """Write one more frame; timestamps must increase. Raises RunError if the folder cannot be written."""
        stem = f"{frame.timestamp_s:.6f}"
        units = np.rint(frame.depth_m * api.TUM_UNITS_PER_METRE)
        images = {
            "depth": np.where(units < api.UINT16_MAX, units, 0).astype(np.uint16),
            "rgb": np.rint(frame.color * 255.0).astype(np.uint8),
        }
        with self._writing():
            for part, image in images.items():
                Image.fromarray(image).save(self.folder / part / f"{stem}.png", compress_level=1)
            for part in images:
                with (self.folder / f"{part}.txt").open("a", encoding="utf-8") as file:
                    file.write(f"{'' if file.tell() else HEAD}{stem} {part}/{stem}.png\n")

    def _writing(self) -> AbstractContextManager[None]:
        return api.guarded(self.folder, "choose a writable place", RunError, "the sequence cannot be written")


BONN = api.published(
    "that of the Bonn data set", Camera(640, 480, 542.822841, 542.57687, 315.59352, 237.756098),
    api.TUM_UNITS_PER_METRE, (0.039903, -0.099343, -0.00073, -0.000144, 0.0),
)  # fmt: skip
T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
T_MARKERS_CAMERA = se3.orthonormalise(
    np.array([
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0.0, 0.0, 0.0, 1.0],
    ])
)  # fmt: skip


ICL_NUIM = api.published("that of ICL-NUIM", Camera(640, 480, 481.2, 480.0, 319.5, 239.5), api.TUM_UNITS_PER_METRE)
STEMS = "associations", "association", "associate", "associated", "assoc", "associate_with_groundtruth"
LIST_NAMES = tuple(f"{stem}.txt" for stem in STEMS)
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def open_icl_nuim(path: str, settings: InputConfig) -> api.RecordedSource:
    """Open a folder. Raises SourceError if its list, images or ground-truth poses cannot be used."""
    folder = Path(path)
    listed = api.first_file(folder, LIST_NAMES)
    if listed is None:
        raise SourceError(
            f"{folder}: text depth is not supported; take the set's TUM-compatible PNGs (…_frei_png.tar.gz)"
        )
    images, numbered = _listed_pairs(listed)
    mirrored = next(iter(sorted(folder.glob("*.gt.freiburg"))), None)
    rendered = mirrored is not None or "frei_png" in folder.resolve().name
    known = ICL_NUIM if rendered else api.freiburg_calibration(folder)
    truth = api.read_poses(mirrored) if mirrored else api.read_groundtruth(folder)
    if mirrored and truth:
        truth = api.Trajectory(truth.timestamps_s / api.FRAMES_PER_SECOND, MIRROR @ truth.T_world_camera @ MIRROR)
    if truth and known:
        truth = replace(truth, error_rms=(0.0, 0.0) if rendered else MOTION_CAPTURE)
    origins = {"pairs": Origin("by line", f"read from {listed.name}")}
    if numbered:
        origins["times"] = Origin(
            f"1/{api.FRAMES_PER_SECOND:g} s apart", api.ASSUMED, f"times in seconds in {listed.name}"
        )
    source = api.folder_source(folder, settings, images, known, api.TUM_UNITS_PER_METRE, truth, origins=origins)
    source.sensor = source.sensor or ("rendered" if rendered else None)
    return source


def _listed_pairs(path: Path) -> tuple[list[ImagePair], bool]:
    """Read the list, and whether it has frame numbers, not times; the path with "depth" in it is the depth image."""
    images = []
    for times, files in api.read_listed(path, "time depth/path time rgb/path"):
        is_depth = ["depth" in "/".join(file.parts[-2:]) for file in files]
        if sum(is_depth) != 1:
            raise SourceError(f"{path}: expected 'depth' in one path of each line, found {files[0]} and {files[1]}")
        color, depth = is_depth.index(False), is_depth.index(True)
        images.append(ImagePair(times[color], files[color], files[depth]))
    if numbered := all(image.timestamp_s.is_integer() for image in images):
        images = [ImagePair(i.timestamp_s / api.FRAMES_PER_SECOND, i.color, i.depth) for i in images]
    return sorted(images, key=lambda image: image.timestamp_s), numbered


def _has_lists(path: str) -> bool:
    return api.first_file(Path(path), (*COLOR_LISTS, *DEPTH_LISTS)) is not None


def _is_bonn(path: str) -> bool:
    return _has_lists(path) and any("bonn" in part.lower() for part in Path(path).resolve().parts[-3:])


def _is_icl_nuim(path: str) -> bool:
    return api.first_file(Path(path), LIST_NAMES) is not None or any(Path(path).glob("scene_*_0000.depth"))


PLUGIN = (
    SourceFormat("TUM", "rgb.txt and depth.txt", _has_lists, open_tum, priority=1),
    SourceFormat(
        "Bonn dynamic", "TUM's lists under rgbd_bonn_…", _is_bonn, partial(open_tum, bonn=True), 2, "kinect-v1"
    ),
    SourceFormat("ICL-NUIM", "associations.txt", _is_icl_nuim, open_icl_nuim, priority=1),
)
