"""Sequences whose depth a network predicted: recordings with other depth, and colour images or videos without depth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.data.frame import Frame
from sigmasplat.data.frame_arrays import color_from_bytes
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.files.reading import exists
from sigmasplat.input.calibration import MM_PER_METRE, Calibration, resolve_calibration
from sigmasplat.input.color_only import VIDEO_ENDINGS
from sigmasplat.input.folders import (
    COLOR_ENDINGS,
    COLOR_FOLDERS,
    DEPTH_FOLDERS,
    first_subfolder,
    list_images,
    times_of_names,
)
from sigmasplat.input.images import image_size, read_color
from sigmasplat.input.lists import read_poses
from sigmasplat.input.recorded import ImagePair, RecordedSource, Size
from sigmasplat.input.source import Source, Subset
from sigmasplat.input.video import Video
from sigmasplat.plugins.predicted_depth.depth_model import DepthModel
from sigmasplat.plugins.predicted_depth.predicted_files import (
    PredictedByModel,
    PredictedDepth,
    PredictedFolder,
    ReadColor,
)

Floats = NDArray[np.float32]


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
        """Read frame i with its predicted depth."""
        frame = super().frame(i)
        return replace(frame, depth_m=self._depth_of(i, lambda: frame.color), depth_std_m=None)

    def depth_of(self, i: int) -> Floats:
        """Read the predicted depth of frame i. Raises SourceError if it cannot be used."""
        return self._depth_of(self._checked_index(i), lambda: self._color_of(i))

    def depth_std_of(self, i: int) -> Floats | None:
        """Return None: networks do not say how wrong they are."""
        return None

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
        """Read 8-bit RGB [H, W, 3]. Raises SourceError naming `color`."""
        return super().read_color() if self.video is None else self.video.frame(self.number)

    def read_depth(self, units_per_metre: float) -> Floats:
        """Read the predicted depth [H, W]; its unit does not matter. Raises SourceError naming `depth`."""
        return self.predicted.depth_of(self.number, *self.size, lambda: color_from_bytes(self.read_color()))

    def read(self, units_per_metre: float) -> tuple[NDArray[np.uint8], Floats, None]:
        """Read colour once, and the depth that may be predicted from it."""
        color = self.read_color()
        return color, self.predicted.depth_of(self.number, *self.size, lambda: color_from_bytes(color)), None

    def sizes(self) -> tuple[Size, Size]:
        """Return (width, height) of colour and of depth, which is resized to it."""
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
        return PredictedByModel(model, len(names), read_color, settings.predicted_inverse)
    return PredictedFolder(Path(settings.predicted_depth), names, settings.predicted_inverse)


def _color_images(folder: Path) -> list[Path]:
    return list_images(first_subfolder(folder, COLOR_FOLDERS) or folder, COLOR_ENDINGS)


def _say_predicted(source: Source, predicted: PredictedDepth) -> None:
    source.predicted_depth, source.computed_depth, source.depth_model = True, False, predicted.model
    source.depth_noise_per_m, source.sensor, source.depth_registered = None, None, False
