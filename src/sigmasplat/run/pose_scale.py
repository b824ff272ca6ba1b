"""Measure the unit of given poses: the images and their depth show the same motions in metres."""

from dataclasses import dataclass

import numpy as np

from sigmasplat.config import Config
from sigmasplat.errors import SourceError
from sigmasplat.model import se3
from sigmasplat.slam.features import Extractor, make_extractor
from sigmasplat.slam.localisation.feature_image import FeatureImage, LateDetail, motion_by_features
from sigmasplat.sources.base import Source
from sigmasplat.types import Matrix

PLACES, STEPS = 12, (32, 16, 8, 4, 2, 1)
"""Number of places of the sequence where motions are compared, and the numbers of frames that a motion may take,
the first choice first."""
LEAST_M, MOST_M = 0.05, 0.6
"""A motion is compared if the images show this length, for a room; features measure longer ones less well."""
FEWEST = 3
"""A scale is measured from at least this many motions."""
TOLERANCE = 0.1
"""Poses whose measured scale differs from 1 by less than this are taken to be in metres."""


@dataclass(frozen=True)
class PoseScale:
    """factor: from the unit of given poses to metres, the median of some measured motions; spread: median relative
    difference of these from it."""

    factor: float
    spread: float


def with_measured_scale(source: Source, config: Config) -> Config:
    """Return the settings with `input.poses_scale` as the images show it. Raises SourceError if they do not show it."""
    measured = measured_scale(source, config)
    if measured is None:
        raise SourceError(
            f"{config.input.poses}: the images do not show the unit of the poses; give the factor to metres as "
            "input.poses_scale, 1 for metres"
        )
    return config.changed(input={"poses_scale": measured.factor})


def scale_warning(source: Source, config: Config) -> str | None:
    """Return what to say if the images show another scale of the given poses; None if they agree or show none."""
    measured = measured_scale(source, config)
    if measured is None or abs(measured.factor - 1.0) < TOLERANCE + measured.spread:
        return None
    return (
        f"the images show motions {measured.factor:.2f} times as long as the given poses; are the poses in metres? "
        "--set input.poses_scale=0 measures their unit"
    )


def measured_scale(source: Source, config: Config) -> PoseScale | None:
    """Compare given motions with those that features and depth show; None if too few can be compared."""
    extractor, ratios = make_extractor(config.features), list[float]()
    for first in np.unique(np.linspace(0, len(source) - 1, PLACES, endpoint=False).astype(int)).tolist():
        ratio = _ratio_at(first, source, config, extractor)
        ratios += [] if ratio is None else [ratio]
    if len(ratios) < FEWEST:
        return None
    factor = float(np.median(ratios))
    return PoseScale(factor, float(np.median(np.abs(np.array(ratios) / factor - 1.0))))


def _ratio_at(first: int, source: Source, config: Config, extractor: Extractor) -> float | None:
    """Return the length in metres of the longest motion from a frame that can be measured, divided by its given length;
    None if there is none."""
    begin, room = _seen(source, first, config), source.scene_scale
    if begin is None:
        return None
    for step in STEPS:
        later = _seen(source, first + step, config) if first + step < len(source) else None
        T_later_begin = None if later is None else motion_by_features(begin[0], later[0], extractor)
        if later is None or T_later_begin is None:
            continue
        length_m = float(np.linalg.norm(T_later_begin[:3, 3]))
        given = float(np.linalg.norm((se3.inverse(begin[1]) @ later[1])[:3, 3]))
        if LEAST_M * room < length_m < MOST_M * room and given > 0:
            return length_m / given
    return None


def _seen(source: Source, i: int, config: Config) -> tuple[FeatureImage, Matrix] | None:
    """Return a frame as features need it, and its given pose; None if it cannot be read."""
    try:
        frame = source.frame(i)
    except SourceError:
        return None
    if frame.T_given_camera is None:
        return None
    c = config.input
    working = frame.prepared(c.width or frame.camera.width, c.min_depth_m, c.max_depth_m, c.crop_px)
    image = FeatureImage(LateDetail(frame, config.features.width), working.depth_m, working.camera)
    return image, np.asarray(frame.T_given_camera)
