"""Read stereo pairs in lists as TUM's, and compute their depth.

rgb.txt right.txt [groundtruth.txt]   lines of "t path"; rgb/ is the left camera
calibration.json                      fx fy cx cy baseline_m: both images are rectified, with the same camera

Depth belongs to the left image. It is computed from both images when a frame is read (`stereo_matching`).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sigmasplat.api as api
from sigmasplat.api import SourceError
from sigmasplat.plugins.sources.stereo_matching import StereoMatcher, scene_scale
from sigmasplat.plugins.sources.tum import read_list


@dataclass(frozen=True)
class StereoPair(api.ImagePair):
    """The left image (`color`) and the right image (`depth`) of one frame."""

    matcher: StereoMatcher

    def read_depth(self, units_per_metre: float) -> NDArray[np.float32]:
        """Match both images: depth of the left one in metres [H, W]. Raises SourceError naming the file."""
        return self.read(units_per_metre)[1]

    def read(self, units_per_metre: float) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Read both images once: the left one and its depth."""
        left, right = self._read(self.color), self._read(self.depth)
        return left, self.matcher.depth_and_std_m(left, right)[0]

    def _read(self, path: Path) -> NDArray[np.uint8]:
        image, c = api.read_color(path), self.matcher.camera
        if image.shape != (c.height, c.width, 3):
            raise SourceError(
                f"{path} is {image.shape[1]}×{image.shape[0]} but the calibration is for {c.width}×{c.height}, 8 bits; "
                "take images of that size, or correct the calibration of the stereo pair"
            )
        return image


class StereoSource(api.RecordedSource):
    """A sequence of stereo pairs, with the depth of the left images."""

    computed_depth = True


def open_stereo(place: str, settings: api.InputConfig) -> StereoSource:
    """Open a folder of stereo pairs. Raises SourceError if lists, images, calibration or poses cannot be used."""
    folder, name = Path(place), Path(place).resolve().name
    (left_s, lefts), (right_s, rights) = (read_list(folder / name) for name in ("rgb.txt", "right.txt"))
    indices, alone = api.pair_times(folder, {"left": left_s, "right": right_s - settings.depth_delay_s}, settings)
    skipped = [f"{lefts[i]}: no right image" for i in alone]
    path = Path(settings.calibration or folder / "calibration.json")
    found = api.resolve_calibration(folder, None, api.first_size([lefts[i] for i, _ in indices]), settings, 1.0)
    if not path.is_file():
        raise SourceError(f"{folder}: the baseline of the stereo pair is unknown; write {path} with baseline_m, metres")
    if found.distortion and settings.undistort:
        raise SourceError(f'{path}: field "distortion" is given, but a stereo pair must be rectified; rectify it first')
    baseline_m = api.positive_number(path, api.read_json_object(path), "baseline_m")
    truth = api.read_groundtruth(folder)
    if settings.depth_scale:
        raise SourceError(f"{name}: input.depth_scale does not apply to a stereo pair; correct its baseline")
    matcher = StereoMatcher(found.camera, baseline_m)
    images = [StereoPair(float(left_s[i]), lefts[i], rights[j], matcher) for i, j in indices]
    source = StereoSource(name, images, api.Calibration(found.camera, 1.0), settings, truth, skipped)
    source.depth_noise_per_m, source.scene_scale = matcher.noise_per_m, scene_scale(source.depth_of, len(source))
    return source


def _recognises(path: str) -> bool:
    folder = Path(path)
    with_depth = (folder / "depth.txt").is_file() or (folder / "depth").is_dir()
    return not with_depth and (folder / "rgb.txt").is_file() and (folder / "right.txt").is_file()


PLUGIN = api.SourceFormat("stereo pair", "rgb.txt and right.txt", _recognises, open_stereo, priority=2)
