"""Sequences whose depth a network predicted: recordings with other depth, and colour images or videos without depth.

Depth, or inverse depth, is in a folder with one image per frame, or comes from the network itself.
"""

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.api import (
    COLOR_ENDINGS,
    COLOR_FOLDERS,
    DEPTH_ENDINGS,
    DEPTH_FOLDERS,
    MM_PER_METRE,
    PLAUSIBLE_MEDIAN_M,
    VIDEO_ENDINGS,
    Calibration,
    Frame,
    ImagePair,
    InputConfig,
    RecordedSource,
    Size,
    Source,
    SourceError,
    Subset,
    Trajectory,
    Video,
    color_from_bytes,
    exists,
    first_readable,
    first_subfolder,
    image_size,
    list_images,
    read_color,
    read_npy,
    read_poses,
    read_values,
    resolve_calibration,
    times_of_names,
)
from sigmasplat.plugins.predicted_depth.depth_model import DepthModel

Floats = NDArray[np.float32]
ReadColor = Callable[[], Floats]
"""Reads the colour of a frame [H, W, 3] in [0, 1]."""

MEDIAN_M = 2.0
"""Median depth of the first image if its unit is unknown: settings in metres expect a room."""
MOST_KEPT_PIXELS = 8_000_000
"""Predictions that are kept, 32 MB."""


class PredictedDepth:
    """The predicted depth of all frames of a recording, in metres of an arbitrary scale.

    One factor brings all images to the size of a room; it is 1 if the first image already looks like metres (floats) or
    millimetres (whole numbers).
    """

    def __init__(
        self, paths: Sequence[Path], inverse: bool, read: Callable[[int, ReadColor], NDArray[Any]],
        hints: tuple[str, str], model: Mapping[str, str] | None = None,
    ) -> None:  # fmt: skip
        """paths: what names the depth of each frame in messages; inverse: whether values are inverse depth; read: reads
        the prediction of a frame, with the number of each pixel in the last two axes; hints: what to check if there is
        no depth, and what to do about NaN; model: name and SHA-256 of the file that predicts it, None if it is in
        files."""
        self.paths, self.model = paths, model
        self._inverse, self._read, self._hints, self._factor = inverse, read, hints, 1.0

    def scaled_by(self, i: int, color: ReadColor) -> "PredictedDepth":
        """Find the factor from frame i; return self. Raises SourceError if its depth cannot be used."""
        first = self._depth(i, color)
        known = first[first > 0]
        if not len(known):
            raise SourceError(
                f"{self.paths[i]}: predicted depth has no value above 0; check how it was {self._hints[0]}"
            )
        median = float(np.median(known))
        if self._inverse or not PLAUSIBLE_MEDIAN_M[0] <= median <= PLAUSIBLE_MEDIAN_M[1]:
            self._factor = MEDIAN_M / median
        return self

    def depth_of(self, i: int, width: int, height: int, color: ReadColor) -> Floats:
        """Return the depth of frame i [height, width], 0 where it is unknown; color: reads the frame's colour. Raises
        SourceError if it cannot be used."""
        depth_m = self._depth(i, color) * np.float32(self._factor)
        if depth_m.shape == (height, width):
            return depth_m
        resized = Image.fromarray(depth_m).resize((width, height), Image.Resampling.NEAREST)
        return np.asarray(resized, np.float32)

    def _depth(self, i: int, color: ReadColor) -> Floats:
        values, path = self._read(i, color), self.paths[i]
        if values.ndim == 3 and 1 in values.shape[::2]:
            values = values[..., 0] if values.shape[2] == 1 else values[0]
        if values.ndim != 2 or values.dtype.kind not in "uif":
            raise SourceError(
                f"{path}: not predicted depth (found {values.dtype} {values.shape}); give one number for each pixel"
            )
        read = values.astype(np.float32)
        if bad := int((~np.isfinite(read)).sum()):
            raise SourceError(f"{path}: predicted depth holds {bad} NaN or inf pixels; {self._hints[1]}")
        if values.dtype.kind in "ui":
            read = read / np.float32(MM_PER_METRE)
        if not self._inverse:
            return np.maximum(read, np.float32(0.0))
        usable = read > np.finfo(np.float32).tiny * 1e6
        return np.where(usable, 1.0 / np.where(usable, read, 1.0), 0.0).astype(np.float32)


def predicted_in_folder(folder: Path, names: Sequence[str], inverse: bool) -> PredictedDepth:
    """Return the depth of the images of a folder: by name if the first frame's name (without ending) occurs, else in
    order. names: those of the frames, or empty names. Raises SourceError if there is not one image for each frame."""
    if not folder.is_dir():
        raise SourceError(f"no such folder: {folder}; give the folder of the predicted depth, one image per frame")
    found = list_images(folder, DEPTH_ENDINGS)
    by_name = {path.stem: path for path in found}
    if names and names[0] in by_name:
        missing = [name for name in names if name not in by_name]
        if missing:
            raise SourceError(
                f"{folder}: no predicted depth for {len(missing)} of {len(names)} frames (first: {missing[0]}); "
                "predict it for every frame"
            )
        found = [by_name[name] for name in names]
    if len(found) != len(names):
        raise SourceError(
            f"{folder}: found predicted depth of {len(found)} frames, there are {len(names)}; give one for each"
        )

    def read(i: int, color: ReadColor) -> NDArray[Any]:
        return read_npy(found[i]) if found[i].suffix.lower() == ".npy" else read_values(found[i])

    hints = "stored", "write 0 where it is unknown"
    return PredictedDepth(found, inverse, read, hints).scaled_by(0, lambda: np.zeros((0, 0, 3), np.float32))


def predicted_by_model(
    model: DepthModel, frames: int, read_color: Callable[[int], Floats], inverse: bool
) -> PredictedDepth:
    """Return the depth that a network predicts from the colour of a frame when the frame is read.

    Predictions of the newest frames are kept, so that reading a frame again does not predict again. Several threads may
    read. Raises SourceError if the depth of the first frame whose colour can be read cannot be used.
    """
    kept, lock = OrderedDict[int, Floats](), Lock()

    def read(i: int, color: ReadColor) -> Floats:
        with lock:
            if i not in kept:
                kept[i] = model.predict(color())
                while len(kept) > 1 and sum(each.size for each in kept.values()) > MOST_KEPT_PIXELS:
                    kept.popitem(last=False)
            return kept[i]

    hints = "trained, and what colours it expects", "the network does not fit these images"
    made = PredictedDepth([model.path] * frames, inverse, read, hints, {"file": model.name, "sha256": model.sha256})
    first, color = first_readable(range(frames), lambda i: (i, read_color(i)))
    return made.scaled_by(first, lambda: color)


class WithPredictedDepth(Subset):
    """Another source with predicted depth instead of its own.

    Raises SourceError if the depth does not fit the frames, or the source is a live camera.
    """

    def __init__(self, whole: Source, settings: InputConfig) -> None:
        if whole.live:
            given = settings.predicted_depth or settings.depth_model
            raise SourceError(f"{given}: predicted depth is for recordings only; record the camera, then run the file")
        super().__init__(whole, InputConfig())
        self._predicted = _predicted_depth(settings, [""] * len(whole), self._color_of)
        self.depth_units_per_metre = None
        _say_predicted(self, self._predicted)

    def frame(self, i: int) -> Frame:
        frame = super().frame(i)
        return replace(frame, depth_m=self._depth_of(i, lambda: frame.color))

    def depth_of(self, i: int) -> Floats:
        return self._depth_of(self._checked_index(i), lambda: self._color_of(i))

    def _color_of(self, i: int) -> Floats:
        return super().frame(i).color

    def _depth_of(self, i: int, color: ReadColor) -> Floats:
        return self._predicted.depth_of(i, self.camera.width, self.camera.height, color)


@dataclass(frozen=True)
class PredictedPair(ImagePair):
    """A colour image, or a frame of a video, and its predicted depth."""

    number: int
    size: Size
    predicted: PredictedDepth
    video: Video | None

    def read_color(self) -> NDArray[np.uint8]:
        return super().read_color() if self.video is None else self.video.frame(self.number)

    def read_depth(self, units_per_metre: float) -> Floats:
        return self.predicted.depth_of(self.number, *self.size, lambda: color_from_bytes(self.read_color()))

    def read(self, units_per_metre: float) -> tuple[NDArray[np.uint8], Floats, None]:
        """Read colour once, and the depth that may be predicted from it."""
        color = self.read_color()
        return color, self.predicted.depth_of(self.number, *self.size, lambda: color_from_bytes(color)), None

    def sizes(self) -> tuple[Size, Size]:
        return self.size, self.size


class ColorOnly(RecordedSource):
    """A video, or a folder of colour images, with predicted depth."""

    def __init__(
        self, name: str, images: Sequence[PredictedPair], calibration: Calibration, settings: InputConfig,
        truth: Trajectory | None, predicted: PredictedDepth,
    ) -> None:  # fmt: skip
        self.depth_model = predicted.model  # known before depth is looked for: that would predict several frames
        super().__init__(name, images, calibration, settings, truth)
        _say_predicted(self, predicted)


def lacks_depth(path: Path, recognised: bool) -> bool:
    """Return whether a path is a video, or a folder of colour images without depth images; recognised: whether a format
    is sure of it."""
    if path.suffix.lower() in VIDEO_ENDINGS:
        return path.is_file()
    return (
        not recognised and path.is_dir() and first_subfolder(path, DEPTH_FOLDERS) is None and bool(_color_images(path))
    )


def open_color_only(path: Path, settings: InputConfig) -> "ColorOnly":
    """Open a video or a folder of colour images with predicted depth.

    A folder may contain calibration.json and groundtruth.txt, as a plain folder. Raises SourceError if the images do
    not fit, or the camera is unknown.
    """
    video = Video(path) if path.is_file() else None
    if video:
        colors, size, names = [path] * video.count, video.size, [""] * video.count
        times_s = [i / video.frames_per_second for i in range(video.count)]
    else:
        colors = _color_images(path)
        size, names = image_size(colors[0]), [color.stem for color in colors]
        times_s = times_of_names(colors)

    calibration = resolve_calibration(path, None, size, settings, MM_PER_METRE)

    def color_of(i: int) -> Floats:
        return color_from_bytes(video.frame(i) if video else read_color(colors[i]))

    predicted = _predicted_depth(settings, names, color_of)
    images = [
        PredictedPair(t, color, depth, number, size, predicted, video)
        for number, (t, color, depth) in enumerate(zip(times_s, colors, predicted.paths, strict=True))
    ]
    truth_path = path / "groundtruth.txt"
    truth = read_poses(truth_path) if path.is_dir() and exists(truth_path) else None
    return ColorOnly(path.resolve().name, images, replace(calibration, depth_camera=None), settings, truth, predicted)


def _predicted_depth(
    settings: InputConfig, names: Sequence[str], read_color: Callable[[int], Floats]
) -> PredictedDepth:
    """Open the folder, or the network, that the settings name, for frames of these names."""
    if settings.depth_model:
        model = DepthModel(Path(settings.depth_model), settings)
        return predicted_by_model(model, len(names), read_color, settings.predicted_inverse)
    return predicted_in_folder(Path(settings.predicted_depth), names, settings.predicted_inverse)


def _color_images(folder: Path) -> list[Path]:
    return list_images(first_subfolder(folder, COLOR_FOLDERS) or folder, COLOR_ENDINGS)


def _say_predicted(source: Source, predicted: PredictedDepth) -> None:
    source.predicted_depth, source.computed_depth, source.depth_model = True, False, predicted.model
    source.depth_noise_per_m, source.sensor, source.depth_registered = None, None, False
