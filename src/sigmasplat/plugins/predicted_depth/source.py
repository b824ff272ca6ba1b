"""Sequences whose depth a network predicted: recordings with other depth, and colour images or videos without depth.

Depth, or inverse depth, is in a folder with one image per frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import sigmasplat.api as api
from sigmasplat.api import InputConfig, Size, Source, SourceError

Floats = NDArray[np.float32]
MEDIAN_M = 2.0
"""Median depth of the first image if its unit is unknown: settings in metres expect a room."""


class PredictedDepth:
    """The predicted depth of all frames of a recording, in metres of an arbitrary scale.

    One factor brings all images to the size of a room; it is 1 if the first image already looks like metres (floats) or
    millimetres (whole numbers).
    """

    def __init__(self, paths: Sequence[Path], inverse: bool) -> None:
        """paths: the file of each frame; inverse: whether values are inverse depth. Raises SourceError if the depth of
        the first frame cannot be used."""
        self.paths, self._inverse, self._factor = paths, inverse, 1.0
        first = self._depth(0)
        known = first[first > 0]
        if not len(known):
            raise SourceError(f"{paths[0]}: predicted depth has no value above 0; check how it was stored")
        median = float(np.median(known))
        if inverse or not api.PLAUSIBLE_MEDIAN_M[0] <= median <= api.PLAUSIBLE_MEDIAN_M[1]:
            self._factor = MEDIAN_M / median

    def depth_of(self, i: int, width: int, height: int) -> Floats:
        """Return the depth of frame i [height, width], 0 where it is unknown. Raises SourceError if it is unusable."""
        depth_m = self._depth(i) * np.float32(self._factor)
        if depth_m.shape == (height, width):
            return depth_m
        resized = Image.fromarray(depth_m).resize((width, height), Image.Resampling.NEAREST)
        return np.asarray(resized, np.float32)

    def _depth(self, i: int) -> Floats:
        path = self.paths[i]
        values = api.depth_values(path)
        if values.ndim == 3 and 1 in values.shape[::2]:
            values = values[..., 0] if values.shape[2] == 1 else values[0]
        if values.ndim != 2 or values.dtype.kind not in "uif":
            raise SourceError(
                f"{path}: not predicted depth (found {values.dtype} {values.shape}); give one number for each pixel"
            )
        read = values.astype(np.float32)
        if bad := int((~np.isfinite(read)).sum()):
            raise SourceError(f"{path}: predicted depth holds {bad} NaN or inf pixels; write 0 where it is unknown")
        if values.dtype.kind in "ui":
            read = read / np.float32(api.MM_PER_METRE)
        if not self._inverse:
            return np.maximum(read, np.float32(0.0))
        usable = read > np.finfo(np.float32).tiny * 1e6
        return np.where(usable, 1.0 / np.where(usable, read, 1.0), 0.0).astype(np.float32)


def predicted_in_folder(folder: Path, names: Sequence[str], inverse: bool) -> PredictedDepth:
    """Return the depth of the images of a folder: by name if the first frame's name (without ending) occurs, else in
    order. names: those of the frames, or empty names. Raises SourceError if there is not one image for each frame."""
    if not folder.is_dir():
        raise SourceError(f"no such folder: {folder}; give the folder of the predicted depth, one image per frame")
    found = api.list_images(folder, api.DEPTH_ENDINGS)
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
    return PredictedDepth(found, inverse)


class WithPredictedDepth(api.Subset):
    """Another source with predicted depth instead of its own.

    Raises SourceError if the depth does not fit the frames, or the source is a live camera.
    """

    def __init__(self, whole: Source, settings: InputConfig) -> None:
        refused = f"{settings.predicted_depth}: predicted depth is for recordings only; record the camera, then run"
        super().__init__(whole, refuse_live=f"{refused} the file")
        names, folder = [""] * len(whole), Path(settings.predicted_depth)
        self._predicted = predicted_in_folder(folder, names, settings.predicted_inverse)
        self.depth_units_per_metre = None
        _say_predicted(self)

    def frame(self, i: int) -> api.Frame:
        return replace(super().frame(i), depth_m=self.depth_of(i))

    def depth_of(self, i: int) -> Floats:
        return self._predicted.depth_of(self._checked_index(i), self.camera.width, self.camera.height)


@dataclass(frozen=True)
class PredictedPair(api.ImagePair):
    """A colour image, or a frame of a video, and its predicted depth."""

    number: int
    size: Size
    predicted: PredictedDepth

    def read_depth(self, units_per_metre: float) -> Floats:
        return self.predicted.depth_of(self.number, *self.size)

    def sizes(self) -> tuple[Size, Size]:
        return self.size, self.size


def lacks_depth(path: Path, recognised: bool) -> bool:
    """Return whether a path is a video, or a folder of colour images without depth images; recognised: whether a format
    is sure of it."""
    if path.suffix.lower() in api.VIDEO_ENDINGS:
        return path.is_file()
    return (
        not recognised
        and path.is_dir()
        and api.first_subfolder(path, api.DEPTH_FOLDERS) is None
        and bool(_color_images(path))
    )


def open_color_only(path: Path, settings: InputConfig) -> Source:
    """Open a video or a folder of colour images with predicted depth.

    A folder may contain calibration.json and groundtruth.txt, as a plain folder. Raises SourceError if the images do
    not fit, or the camera is unknown.
    """
    video = api.Video(path) if path.is_file() else None
    if video:
        colors, size, names = [path] * video.count, video.size, [""] * video.count
        times_s, times = np.arange(video.count) / video.frames_per_second, api.Origin("frame rate", f"read from {path}")
    else:
        colors = _color_images(path)
        size, names = api.image_size(colors[0]), [color.stem for color in colors]
        times_s, times = api.times_of_names(colors)
    calibration = api.resolve_calibration(path, None, size, settings, api.MM_PER_METRE)
    predicted = predicted_in_folder(Path(settings.predicted_depth), names, settings.predicted_inverse)
    images = [
        PredictedPair(t, color, depth, number, size, predicted, video=(video, number) if video else None)
        for number, (t, color, depth) in enumerate(zip(times_s.tolist(), colors, predicted.paths, strict=True))
    ]
    truth = api.read_groundtruth(path)
    settings = replace(settings, depth_scale=0.0)
    source = api.RecordedSource(path.resolve().name, images, replace(calibration, depth_camera=None), settings, truth)
    source.origins["times"] = times
    _say_predicted(source)
    return source


def _color_images(folder: Path) -> list[Path]:
    return api.list_images(api.first_subfolder(folder, api.COLOR_FOLDERS) or folder, api.COLOR_ENDINGS)


def _say_predicted(source: Source) -> None:
    source.predicted_depth, source.computed_depth = True, False
    source.origins = {name: origin for name, origin in source.origins.items() if name != "depth unit"}
    source.depth_noise_per_m, source.sensor, source.depth_registered = None, None, False
