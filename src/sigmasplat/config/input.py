"""Settings of the input, for every format: which frames, which calibration, which pixels; how sure the depth readings
of a sensor are: models as numbers, by name."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from sigmasplat.config.ranges import WIDTHS_PX, Above0, AtLeastOne, Count, NotNegative, Range, Section, problem_of
from sigmasplat.errors import ConfigError
from sigmasplat.files.reading import exists, read_json


@dataclass(frozen=True)
class SensorModel:
    """Standard deviation of a depth reading z (m): σ = √(base² + (z1·z)² + (z2·z²)²); `shared` is not part of σ."""

    base: float = 0.0
    """Constant part, metres."""
    z1: float = 0.0
    """Part that grows with z, no unit: time of flight and LiDAR."""
    z2: float = 0.0
    """Part that grows with z², per metre: triangulation."""
    shared: float = 0.0
    """Error that neighbouring readings have in common, such as that of the calibration, times z², per metre. Alignment
    averages over neighbours, which does not reduce this error."""


SENSORS = {
    # Khoshelham & Elberink 2012: σ = 1.4e-3 z². Nguyen et al. 2012: 1.2 mm + 1.9 mm/m² (z − 0.4 m)², which base and z2
    # meet within 8 % from 0.6 to 4 m. `shared` is ours: with noise alone, the path of redkitchen is 2 % worse than with
    # 3e-3 z² in all, the generic law.
    "kinect-v1": SensorModel(base=0.0012, z2=0.0015, shared=0.0025),
    # Grunnet-Jepsen et al. 2018 (tuning of D400): σ = z² · subpixel error / (f · baseline), with 0.08 px, 424 px (848
    # pixels wide), 50 mm.
    "realsense-stereo": SensorModel(base=0.001, z2=0.0038),
    # Luetzenburg et al. 2021: 1 cm on objects of a room, hardly dependent on z.
    "lidar-iphone": SensorModel(base=0.005, z1=0.005),
    # Fankhauser et al. 2015 (Kinect v2): 1.5 − 0.5 z + 0.3 z² mm; Tölgyessy et al. 2021 (Azure Kinect) and Hübner et
    # al. 2020 (HoloLens) find a similar growth.
    "time-of-flight": SensorModel(base=0.0012, z1=0.0005, z2=0.00025),
}
"""Models of σ by sensor."""


RENDERED = "rendered"
"""Images of a renderer: their calibration and their times are exact; readings follow the generic law."""


def sensor_model(name: str) -> SensorModel | None:
    """Return the model of a sensor that `input.sensor` names; None for the generic law."""
    return SENSORS.get(name)


RECORDED_POSES = "recorded"
"""Value of `input.poses` for the poses that the recording device estimated itself."""
TIMES = ("depth_late_s", "depth_rows_s", "color_rows_s", "std_s", "std_s", "std_s")
CAMERA = ("focal", "center_x", "center_y", "inverse_depth", "falloff", *["std"] * 5)
"""Numbers of a file for `input.calibrate`, which is JSON; those of the camera may be missing."""
TIMES_NEEDED = "input.calibrate needs auto, off, or a file that `sigmasplat calibrate PATH` has written"


def sensor_numbers(given: str) -> str:
    """Return `TIMES` and `CAMERA` as numbers with commas, from such text, a file, or the run.json of a run. Raises
    ConfigError."""
    values: Any = given.split(",")
    if len(values) in (len(TIMES), len(TIMES + CAMERA)):
        with suppress(ValueError):
            values = [float(value) for value in values]
    elif exists(Path(given)):
        found = read_json(Path(given), ConfigError)
        found = found if isinstance(found, dict) else {}
        values = _numbers(found.get("sensor_times", found), TIMES)
        if found.get("camera_errors"):
            values += _numbers(found["camera_errors"], CAMERA)
    else:
        raise ConfigError(f"no file {given!r}; {TIMES_NEEDED}")
    for name, value in zip(TIMES + CAMERA, values, strict=False):
        if problem := problem_of(Annotated[float, Range(0 if name.startswith("std") else -1, 1)], value):
            raise ConfigError(f"{given}: {name} {problem}; {TIMES_NEEDED}")
    return ",".join(f"{value:g}" for value in values)


def _numbers(found: Any, names: Sequence[str]) -> list[Any]:
    """Return the values of a section of a file by name, and those of the list that the last names share; None for each
    that is missing."""
    found, single = found if isinstance(found, dict) else {}, [name for name in names if name != names[-1]]
    listed = found.get(names[-1]) if isinstance(found.get(names[-1]), list) else []
    return [*map(found.get, single), *[*listed, *[None] * len(names)][: len(names) - len(single)]]


@dataclass(frozen=True)
class InputConfig(Section, name="input"):
    """Selection and processing of the frames of a source. Raises ConfigError on invalid values."""

    stride: AtLeastOne = 1
    """Use every N-th frame."""
    limit: Count = 0
    """Maximum number of frames; 0 = all."""
    start_s: NotNegative = 0.0
    """Start this many seconds after the first frame of the recording."""
    end_s: NotNegative = 0.0
    """Stop this many seconds after the first frame of the recording; 0 = at its end."""
    hold_every: Annotated[int, Range(2, or_zero=True)] = 0
    """Hold back every N-th frame: it is tracked but never becomes a keyframe, so that it can test the map; 0 = none."""
    strict: bool = False
    """Whether an unreadable image stops the run. If off, such images are skipped and counted."""

    max_gap_s: Above0 = 0.02  # as in TUM's own tool; half a step at 25 Hz
    """Colour and depth that are paired by time differ by less than this, in seconds."""
    depth_delay_s: Annotated[float, Range()] = 0.0
    """How much too late depth (or the right image of a pair) is stamped, in seconds, if images are paired by time."""
    color_topic: str = ""
    """Topic of the colour images in a ROS bag; empty = detected from the messages."""
    depth_topic: str = ""
    """Topic of the depth images in a ROS bag; empty = detected from the messages."""

    calibration: str = ""
    """Path of a calibration.json that replaces the calibration of the recording; empty = as recorded."""
    masks: str = ""
    """Path of a folder with one image per frame of the recording, in the order of the numbers in their names: pixels
    that are not 0 are ignored in tracking, in the map and in scores; empty = none."""
    filters: str = ""
    """Masks and depth filters of plug-ins that change each frame, in this order, separated by commas. They change what
    SLAM sees; scores use the frames as they were recorded. Empty = none."""
    predicted_depth: str = ""
    """Path of a folder with depth that a network predicted, one image per frame of the recording; it replaces the
    recorded depth, or is the depth of a video or of colour images. Its scale may be arbitrary; empty = none."""
    predicted_inverse: bool = False
    """Whether predicted depth is inverse depth (disparity), as most networks for relative depth give it."""
    predicted_scale: NotNegative = 0.0
    """Factor from predicted depth to metres, used with `input.poses` only; 0 = measured from the poses and the images,
    unless `input.poses_scale` is 0."""
    poses: str = ""
    """Path of a file with known camera poses, which are used as they are: TUM text, KITTI text, images.txt of COLMAP,
    or transforms.json; or of a folder with a matrix per frame; "recorded" = those that the device estimated itself,
    such as ARKit's. Frames without a pose are left out; empty = poses are estimated."""
    poses_scale: NotNegative = 1.0
    """Factor from the unit of `input.poses` to metres; 0 = measured from the images and their depth, for poses of
    arbitrary scale such as COLMAP's."""
    fx: NotNegative = 0.0
    """Horizontal focal length of the colour camera in pixels; 0 = as recorded."""
    fy: NotNegative = 0.0
    """Vertical focal length of the colour camera in pixels; 0 = as recorded, or equal to fx if nothing is recorded."""
    cx: NotNegative = 0.0
    """Column of the colour camera's principal point in pixels; 0 = as recorded, or the image centre if nothing is
    recorded."""
    cy: NotNegative = 0.0
    """Row of the colour camera's principal point in pixels; 0 = as recorded, or the image centre if nothing is
    recorded."""
    depth_scale: NotNegative = 0.0
    """Units of the depth images per metre; 0 = as recorded."""

    depth_along: Literal["auto", "z", "ray"] = "auto"
    """What a depth value is: z = depth along the optical axis, and no value is dropped; ray = distance along the ray of
    the pixel, which is converted; auto = what planes in the images show, z if they show nothing. With auto and ray, a
    largest value that many readings have, which stands for no reading, is dropped."""
    register_depth: Literal["auto", "on", "off"] = "auto"
    """Whether depth is registered to the pixels of the colour camera; auto = if the recording has a separate depth
    camera."""
    undistort: bool = True
    """Whether lens distortion is removed, if it is known."""
    width: Annotated[int, WIDTHS_PX] = 320  # a quarter of the pixels of 640×480, which determine the cost of rendering
    """Width of the working images in pixels, height in proportion; 0 = as in the source."""
    crop_px: Count = 0
    """Pixels removed at each edge after resizing, for undistorted images or sensors without depth at the edges."""
    min_depth_m: NotNegative = 0.1
    """Smaller depth readings are ignored: below its range a sensor returns noise."""
    max_depth_m: Above0 = 8.0
    """Larger depth readings are ignored: their errors grow with the square of the depth."""
    sensor: Literal[
        "auto", "generic", "kinect-v1", "realsense-stereo", "lidar-iphone", "time-of-flight", "rendered"
    ] = "auto"
    """Model of the standard deviation of depth readings: that of a sensor (docs/data.md); generic = the law of
    `render.depth_noise_per_m`; rendered = the same law, with an exact calibration and exact times; auto = that of the
    sensor if the source knows it, otherwise generic."""
    calibrate: str = "auto"
    """Correction of when the sensor reads depth and rows (rolling shutter): auto = times measured from keyframes that
    are aligned to each other, but not for rendered images, nor for predicted or stereo depth; off = none; or the path
    of a file of `sigmasplat calibrate`, with times and errors of the stated camera. A run's settings hold the numbers
    of the file."""
    denoise_depth: bool = True
    """Whether depth images that are noisier than those of a structured-light sensor are smoothed."""

    def __post_init__(self) -> None:
        if isinstance(self.calibrate, str) and self.calibrate not in ("auto", "off"):
            object.__setattr__(self, "calibrate", sensor_numbers(self.calibrate))
        super().__post_init__()

    @property
    def poses_scale_depth(self) -> bool:
        """Return whether known poses give predicted depth its scale."""
        return bool(self.poses and self.predicted_scale)

    def problems(self) -> list[str]:
        """Describe each invalid value, and limits that exclude every frame or every depth reading."""
        if found := super().problems():
            return found
        if self.end_s and self.end_s <= self.start_s:
            found.append(f"input.end_s must be after input.start_s, found {self.start_s:g} to {self.end_s:g} s")
        if self.max_depth_m <= self.min_depth_m:
            found.append(
                "input.max_depth_m must be above input.min_depth_m, "
                f"found {self.min_depth_m:g} to {self.max_depth_m:g} m"
            )
        return found
