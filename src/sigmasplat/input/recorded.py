"""Read recorded sequences: a format lists the image pairs, this module reads and rectifies them. A few depth images are
checked before a run for a wrong unit or missing readings."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.data.frame import Frame
from sigmasplat.data.frame_arrays import color_from_bytes
from sigmasplat.data.images import resized_color
from sigmasplat.data.trajectory import Trajectory, evenly_spaced
from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import ASSUMED, MEASURED, Calibration, Origin, resolve_calibration
from sigmasplat.input.depth_meaning import MOST_PIXELS, NORMALISED, SAMPLES, ends_at_one, meaning_of, thinned
from sigmasplat.input.given import SAME_SHAPE
from sigmasplat.input.images import (
    FRAMES_PER_SECOND,
    Video,
    color_origins,
    image_size,
    pair_images,
    read_color,
    read_depth,
)
from sigmasplat.input.imu import Accelerometer, Gyroscope
from sigmasplat.input.intrinsics import intrinsics_beside
from sigmasplat.input.lists import poses_beside
from sigmasplat.input.rectification import Rectification, check_image_sizes, resampled, turned_by_tag
from sigmasplat.input.source import Source

PLAUSIBLE_MEDIAN_M = (0.2, 15.0)
"""The median depth of indoor sequences is well inside this range; with a wrong power of ten it is outside."""

KNOWN_UNITS_PER_METRE = {
    1000.0: "millimetres", 5000.0: "TUM's unit", 6553.5: "Replica's unit", 1.0: "metres", 10_000.0: "tenths of mm",
    256.0: "KITTI's unit", 100.0: "centimetres",
}  # fmt: skip


def depth_warning(source: Source, samples: int = 5, read: Sequence[Frame] = ()) -> str | None:
    """Return a warning if the depth scale looks wrong, with the median and a suggestion; None if it is plausible.

    It is also None if the source computes depth in metres from a stereo pair, because streets are deeper than rooms.
    The median is over all readings of `samples` frames spread evenly, or of those that have been `read` already;
    unreadable frames are left out.
    """
    medians = list(_medians_m(source, evenly_spaced(len(source), samples), read))
    if medians and source.computed_depth:
        return None
    if not medians:
        return f"{source.name}: no depth reading in the frames sampled"
    median_m = float(np.median(medians))
    low, high = PLAUSIBLE_MEDIAN_M
    if low <= median_m <= high:
        return None
    median = np.format_float_positional(median_m, 4, fractional=False, trim="-")
    return (
        f"{source.name}: median depth is {median} m over {len(medians)} frames, outside {low}–{high} m; "
        f"the depth's scale looks wrong{_unit_guess(median_m, source.depth_units_per_metre)}"
    )


def refuse_without_depth(source: Source, samples: int = 5) -> None:
    """Raise SourceError if no frame has a depth reading; reads a few frames, and all frames only if those are blank."""
    if any(_medians_m(source, [*evenly_spaced(len(source), samples), *range(len(source))])):
        return
    problem = "frame 0 has no pixel above 0"
    try:
        source.depth_of(0)
    except SourceError as error:
        problem = str(error)
    raise SourceError(
        f"{source.name}: depth is zero or unreadable in all {len(source)} frames; "
        f"check the depth files (first problem: {problem})"
    )


def _medians_m(source: Source, indices: Iterable[int], read: Sequence[Frame] = ()) -> Iterator[float]:
    """Yield the median reading of each frame that is readable and not blank: of those `read`, otherwise of indices."""
    for i in read or indices:
        with suppress(SourceError):  # reported when the source is iterated
            depth_m = i.depth_m if isinstance(i, Frame) else source.depth_of(i)
            if (depth_m > 0).any():
                yield float(np.median(depth_m[depth_m > 0]))


def _unit_guess(median_m: float, units_per_metre: float | None) -> str:
    """Suggest the known unit whose median is nearest to 2 m, typical for indoors."""
    raw = median_m * (units_per_metre or 1.0)
    guesses = {units: raw / units for units in KNOWN_UNITS_PER_METRE if 0.4 <= raw / units <= 8.0}
    if not guesses:
        return "; give --depth-scale UNITS, the units of the depth images per metre"
    units = min(guesses, key=lambda u: abs(np.log(guesses[u] / 2.0)))
    name, would_be_m = KNOWN_UNITS_PER_METRE[units], guesses[units]
    return f"; --depth-scale {units:g} ({name}) would make it {would_be_m:.2f} m"


Size = tuple[int, int]
File = TypeVar("File")
Value = TypeVar("Value")


@dataclass(frozen=True)
class ImagePair:
    """The colour and the depth file of one frame, its time, how much later the depth is, in seconds, the image of the
    confidence of its readings (`read_depth`), and the video and the number of its colour image, if it is in a video.

    Formats whose images are not separate files (members of an archive, messages of a bag) derive from this class and
    override the readers; the paths then only name the images in error messages.
    """

    timestamp_s: float
    color: Path
    depth: Path
    depth_late_s: float = field(default=0.0, kw_only=True)
    confidence: Path | None = field(default=None, kw_only=True)
    video: tuple[Video, int] | None = field(default=None, kw_only=True)

    def read_color(self) -> NDArray[Any]:
        """Read 8-bit RGB [H, W, 3], or gray of more bits as stored [H, W]. Raises SourceError naming `color`."""
        return self.video[0].frame(self.video[1]) if self.video else read_color(self.color)

    def read_depth(self, units_per_metre: float) -> NDArray[np.float32]:
        """Read depth in metres [H, W], 0 = no reading; whole numbers are divided. Raises SourceError naming `depth`."""
        return read_depth(self.depth, units_per_metre, self.confidence)

    def read(self, units_per_metre: float) -> tuple[NDArray[Any], NDArray[np.float32]]:
        """Read both images, as `read_color` and `read_depth` do."""
        return self.read_color(), self.read_depth(units_per_metre)

    def sizes(self) -> tuple[Size, Size]:
        """Return (width, height) of colour and of depth in pixels. Raises SourceError naming the unreadable file."""
        height, width = self.read_depth(1.0).shape
        return self.video[0].size if self.video else image_size(self.color), (width, height)


class RecordedSource(Source):
    """A sequence of image pairs, rectified to one pinhole camera."""

    def __init__(
        self, name: str, images: Sequence[ImagePair], calibration: Calibration, settings: InputConfig,
        truth: Trajectory | None = None, skipped: Sequence[str] = (), test: Source | None = None,
        gyroscope: Gyroscope | None = None, accelerometer: Accelerometer | None = None, surface: Path | None = None,
        estimated: bool | str = False, origins: Mapping[str, Origin] = MappingProxyType({}),
    ) -> None:  # fmt: skip
        """Store image pairs in order of time; `truth` is the path of the colour camera; `skipped` lists files left out.

        test: separate test views; gyroscope, accelerometer: in the axes of the colour camera; surface: file of the true
        surface; estimated: whether the device, or which program, estimated `truth`; origins: of times, pairs and more.
        Raises SourceError if the first images do not match the calibration, no image has a depth reading, or no image
        was taken while the gyroscope measured.
        """
        self._rectified = Rectification(name, calibration, settings)
        super().__init__(name, self._rectified.camera, settings.strict)
        self.depth_registered = self._rectified.moves_depth
        self.registrable, self.sensor = calibration.depth_camera is not None, calibration.sensor
        self.skipped, self.origins = list(skipped), dict(calibration.origins) | dict(origins)
        self._images, self._truth, self._test = images, truth, test
        self._gyroscope, self._accelerometer = gyroscope, accelerometer
        self._surface, by = surface, f" ({estimated})" * isinstance(estimated, str)
        self.path_by = f"the device{by}" * bool(estimated)
        files, (size, depth_size) = first_readable(images, lambda pair: (pair, pair.sizes()))
        check_image_sizes(self._rectified, files.color, size, files.depth, depth_size)
        self.origins |= color_origins(files.color)
        self._white, self._units = self._measured_white(), calibration.depth_units_per_metre
        floats = not self.computed_depth and self._stores_floats()
        self._float_units = np.float32(settings.depth_scale or 1.0 if floats else 1.0)
        self.depth_units_per_metre = None if floats and not settings.depth_scale else self._units
        if self.depth_units_per_metre is None:
            self.origins["depth unit"] = Origin("metres, as usual for floats", ASSUMED, "--depth-scale UNITS")
        self._refuse_other_clock()
        if not (settings.predicted_depth or self.computed_depth):
            self._look_at_depth(settings)
        refuse_without_depth(self)

    def __len__(self) -> int:
        return len(self._images)

    def timestamp_s(self, i: int) -> float:
        return self._images[self._checked_index(i)].timestamp_s

    def frame(self, i: int) -> Frame:
        """Read frame i: colour and depth of one camera, lens distortion removed."""
        files = self._images[self._checked_index(i)]
        recorded, stored_m = files.read(self._units)
        depth_m, color = self._in_metres(stored_m), color_from_bytes(self._rgb(files.color, recorded))
        check_image_sizes(self._rectified, files.color, color.shape[1::-1], files.depth, depth_m.shape[::-1])
        color, depth_m = self._rectified(self._of_one_camera(i, color), self._of_one_camera(i, depth_m))
        color = resized_color(color, self.camera.width, self.camera.height)
        R_inertial_camera = None if self._gyroscope is None else self._gyroscope.R_inertial_camera(files.timestamp_s)
        force = None if self._accelerometer is None else self._accelerometer.at(files.timestamp_s)
        return Frame(
            i, files.timestamp_s, color, depth_m, self.camera, R_inertial_camera, specific_force_m_s2=force,
            depth_late_s=files.depth_late_s,
        )  # fmt: skip

    def depth_of(self, i: int) -> NDArray[np.float32]:
        files = self._images[self._checked_index(i)]
        depth_m, camera = self._in_metres(files.read_depth(self._units)), self._rectified.calibration.camera
        check_image_sizes(self._rectified, files.color, (camera.width, camera.height), files.depth, depth_m.shape[::-1])
        return self._rectified.depth(self._of_one_camera(i, depth_m))

    def _in_metres(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return depth as it was read, divided by the given units if it is stored as floats."""
        return depth_m if self._float_units == 1.0 else depth_m / self._float_units

    def _of_one_camera(self, i: int, image: NDArray[np.float32]) -> NDArray[np.float32]:
        known = self._rectified.calibration
        other = image.ndim == 2 and known.depth_camera not in (None, known.camera.resized(*image.shape[1::-1]))
        return resampled(image, known.own[i], known.camera) if known.own and not other else image

    def truth(self) -> Trajectory | None:
        return self._truth

    def image_name(self, i: int) -> str:
        return self._images[self._checked_index(i)].color.name

    def device_path(self) -> Trajectory | None:
        """Return the recorded path if the device estimated it."""
        return self._truth if self.path_by else None

    def test_views(self) -> Source | None:
        return self._test

    def true_surface_file(self) -> Path | None:
        return self._surface

    def _stores_floats(self) -> bool:
        """Return whether depth is stored as floats: readings stay if there are ever so many units in a metre."""
        for i in evenly_spaced(len(self), 5):
            with suppress(SourceError):
                if largest := float(self._images[i].read_depth(1e30).max()):
                    return largest > 1e-20
        return False

    def _measured_white(self) -> float:
        """Return the value of gray above 8 bits that becomes white: one power of two for all frames; 0 for 8 bits."""
        largest = 0.0
        for i in evenly_spaced(len(self), 20):
            with suppress(SourceError):
                if (values := self._images[i].read_color()).ndim == 3:
                    return 0.0
                largest = max(largest, float(np.percentile(values, 99.9)))
        white = float(2.0 ** np.ceil(np.log2(largest or 65536.0)))
        self.origins["gray"] = Origin(f"more than 8 bits, value {white:g} becomes white", MEASURED)
        return white

    def _rgb(self, path: Path, recorded: NDArray[Any]) -> NDArray[np.uint8]:
        if recorded.ndim == 3:
            return recorded
        if not (self._white and np.isfinite(recorded).all()):
            raise SourceError(f"{path}: gray of more than 8 bits, among 8-bit images or with NaN; convert it to 8 bits")
        gray = np.clip(recorded * (256.0 / self._white), 0.0, 255.0).astype(np.uint8)
        return np.repeat(gray[..., None], 3, axis=2)

    def _look_at_depth(self, settings: InputConfig) -> None:
        """Find out from a few images what depth values mean, and read them so."""
        found, images, ones = self._rectified, list[NDArray[np.float32]](), list[bool]()
        count = min(SAMPLES, max(3, MOST_PIXELS // int(np.prod(found.depth_size))))
        for i in evenly_spaced(len(self), count if settings.depth_along != "z" else 0):
            with suppress(SourceError):  # reported when the source is iterated
                depth_m = self._in_metres(self._images[i].read_depth(self._units))
                ones.append(self.depth_units_per_metre is None and ends_at_one(depth_m))
                if depth_m.shape[::-1] == found.depth_size:
                    images.append(thinned(found.without_lens(depth_m)))
        meaning = meaning_of(images, found.depth_camera, self._units, settings)
        found.beyond_m = meaning.beyond_m
        found.ray_lengths = found.depth_camera.ray_lengths() if meaning.ray else None
        self.origins = meaning.origins | self.origins
        self.depth_doubts = meaning.doubts + [NORMALISED] * (len(ones) > 2 and all(ones))

    def _refuse_other_clock(self) -> None:
        """Raise SourceError before a run if the gyroscope measured at another time than the images were taken."""
        images_s = np.array([pair.timestamp_s for pair in self._images])
        if self._gyroscope and not self._gyroscope.measured_any(images_s):
            first_s, last_s = self._gyroscope.timestamps_s[[0, -1]]
            raise SourceError(
                f"{self.name}: the gyroscope measured from {first_s:.3f} to {last_s:.3f} s, but the images were taken "
                f"from {images_s[0]:.3f} to {images_s[-1]:.3f} s; use the same clock"
            )


def folder_source(
    folder: Path, settings: InputConfig, images: Sequence[ImagePair], known: Calibration | None, units_per_metre: float,
    truth: Trajectory | None = None, skipped: Sequence[str] = (), name: str = "", one_camera: bool = False, **more: Any,
) -> RecordedSource:  # fmt: skip
    """Build the source of a recording. Its camera is that of the settings, else of calibration.json, else `known`.

    units_per_metre: default of depth_scale; name: if it is not that of the folder; one_camera: whether depth with fewer
    pixels than colour has the same camera, as on phones; more: as for RecordedSource. Raises SourceError as it does.
    """
    size, depth_size = first_readable(images, lambda pair: pair.sizes())
    known = known or intrinsics_beside(folder, settings, size, units_per_metre)
    calibration = resolve_calibration(folder, known, size, settings, units_per_metre)
    camera, lens = calibration.camera, calibration.distortion
    if truth is None and not settings.poses:
        more["origins"] = {**more.get("origins", {}), **poses_beside(folder)}
    if known and known.own and camera != known.camera:
        calibration = replace(calibration, own=())  # one camera is given for all frames
    if not calibration.depth_camera:
        _refuse_other_shape(folder, images, size, depth_size)
    if one_camera and depth_size != (camera.width, camera.height) and not calibration.depth_camera:
        calibration = replace(calibration, depth_camera=camera.resized(*depth_size), depth_distortion=lens)
    return RecordedSource(name or folder.resolve().name, images, calibration, settings, truth, skipped, **more)


def _refuse_other_shape(folder: Path, images: Sequence[ImagePair], *sizes: Size) -> None:
    """Raise SourceError if colour and depth of such sizes are not of one view; those of small images are rounded."""
    (w, h), (depth_w, depth_h) = sizes
    if abs(depth_h - depth_w * h / w) <= max(SAME_SHAPE * depth_h, 1.0):
        return
    pair = first_readable(images, lambda pair: (pair, pair.read_depth(1.0)))[0]  # wrong metadata are named first
    color, depth = (f"{a}×{b} ({'portrait' if b > a else 'landscape'})" for a, b in sizes)
    remedy = "rotate one of them" if (w > h) != (depth_w > depth_h) else "give depth_camera in calibration.json"
    turned = turned_by_tag(pair.color, (w, h), (depth_w, depth_h))
    raise SourceError(f"{folder}: colour is {color}, depth is {depth}; {turned}{remedy}")


def numbered_pairs(
    folder: Path, colors: Mapping[int, Path], depths: Mapping[int, Path], color_name: str, depth_name: str,
    rate_hz: float = FRAMES_PER_SECOND,
) -> tuple[dict[int, ImagePair], list[str]]:  # fmt: skip
    """Return the images of each number that colour and depth share, and why the others are left out, as `pair_images`;
    frame n is taken at n / rate_hz seconds."""
    numbers, skipped = pair_images(folder, colors, depths, color_name, depth_name)
    return {n: ImagePair(n / rate_hz, colors[n], depths[n]) for n in numbers}, skipped


def first_size(paths: Sequence[Path]) -> tuple[int, int]:
    """Return (width, height) of the first image whose header can be read. Raises SourceError if none can."""
    return first_readable(paths, image_size)


def first_readable(files: Iterable[File], read: Callable[[File], Value]) -> Value:
    """Return `read` of the first file for which it raises no SourceError. Raises SourceError if it fails for all."""
    problem: SourceError | None = None
    for file in files:
        try:
            return read(file)
        except SourceError as error:
            problem = problem or error
    raise SourceError(f"no pair of colour and depth can be read (first: {problem})")
