"""Open a sequence together with the settings that belong to its scene: every run gets both from here."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sigmasplat.config import Config
from sigmasplat.config.scale import for_scene
from sigmasplat.data import se3
from sigmasplat.errors import SourceError
from sigmasplat.input.opening import open_source
from sigmasplat.input.source import Source
from sigmasplat.tracking.feature_image import FeatureImage, LateDetail
from sigmasplat.tracking.features import Extractor, Features
from sigmasplat.tracking.predicted_depth_fit import depth_at
from sigmasplat.types import Matrix

PLACES, STEPS = 12, (32, 16, 8, 4, 2, 1)
"""Number of places of the sequence where depth is compared, and the numbers of frames that a motion may take, the first
choice first."""
FEWEST, TOLERANCE = 3, 0.1
"""A scale is measured from at least this many motions; poses whose scale differs from 1 by less are in metres."""
LEAST_MATCHES, LEAST_PARALLAX_DEG, MOST_OFF_PX = 20, 1.5, 2.0
"""Features are triangulated if at least this many are seen from directions that differ by this angle, and at most this
far from where the given motion can show them."""


def with_measured_scale(source: Source, config: Config) -> Config:
    """Return the settings with the scale that the images show: `input.poses_scale`, from the unit of given poses to
    that of depth, if it is 0, else `input.predicted_scale`, from predicted depth to the unit of the poses.

    Raises SourceError if they do not show it.
    """
    measured = measured_scale(source, config)
    if measured is None:
        of_poses = "unit of the poses; give the factor to metres as input.poses_scale, 1 for metres"
        of_depth = "scale of predicted depth in the unit of the poses; give this factor as input.predicted_scale"
        what = of_depth if source.predicted_depth else of_poses
        raise SourceError(f"{config.input.poses}: the images do not show the {what}")
    factor, _ = measured
    found = {"predicted_scale": factor} if config.input.poses_scale else {"poses_scale": 1 / factor}
    return config.changed(input=found)


def scale_warning(source: Source, config: Config) -> str | None:
    """Return what to say if the images show another scale of the given poses; None if they agree or show none."""
    measured = measured_scale(source, config)
    if measured is None or abs(1.0 / measured[0] - 1.0) < TOLERANCE + measured[1]:
        return None
    return (
        f"the images show motions {1.0 / measured[0]:.2f} times as long as the given poses; are the poses in metres? "
        "--set input.poses_scale=0 measures their unit"
    )


def measured_scale(source: Source, config: Config) -> tuple[float, float] | None:
    """Return the factor from depth to the unit of the given poses, the median of some measured motions, and the median
    relative difference of these from it; None if too few can be compared."""
    extractor, rows = Extractor(), np.linspace(0, len(source) - 1, PLACES, endpoint=False).astype(int)
    found = (_ratio_at(first, source, config, extractor) for first in np.unique(rows).tolist())
    ratios = np.array([ratio for ratio in found if ratio is not None])
    if len(ratios) < FEWEST:
        return None
    factor = float(np.median(ratios))
    return factor, float(np.median(np.abs(ratios / factor - 1.0)))


def _ratio_at(first: int, source: Source, config: Config, extractor: Extractor) -> float | None:
    """Return the depth of features of a frame in the unit of the given poses, divided by their depth in the frame, the
    median over the longest motion from it that shows enough of them; None if there is none."""
    begin = _seen(source, first, config)
    if begin is None:
        return None
    features, z = begin[0].features(extractor), depth_at(begin[0], extractor)
    for step in STEPS:
        later = _seen(source, first + step, config) if first + step < len(source) else None
        pairs = extractor.match(features, later[0].features(extractor)) if later else np.zeros((0, 2), np.intp)
        if later is None or len(pairs) < LEAST_MATCHES:
            continue
        a, b = pairs.T
        T_later_begin = se3.inverse(later[1]) @ begin[1]
        shown = triangulated(features.take(a), later[0].features(extractor).take(b), T_later_begin)
        known = (shown > 0) & (z[a] > 0)
        if known.sum() >= LEAST_MATCHES:
            return float(np.median(shown[known] / z[a][known]))
    return None


def triangulated(first: Features, second: Features, T_second_first: Matrix) -> Matrix:
    """Return the depth [M] of matched features of two views in the first one, in the unit of the motion [4, 4] between
    them; 0 if directions differ too little, or the motion cannot show both."""
    R, t, camera = T_second_first[:3, :3], T_second_first[:3, 3], second.camera
    turned, seen = _rays(first) @ R.T, _rays(second)
    across, offset = np.cross(seen, turned), np.cross(seen, t)  # seen × (z · turned + t) = 0
    square = np.maximum((across**2).sum(1), 1e-18)
    z = -(across * offset).sum(1) / square
    parallax = np.sqrt(square) / (np.linalg.norm(seen, axis=1) * np.linalg.norm(turned, axis=1))
    moved = z[:, None] * turned + t
    ahead = (z > 0) & (moved[:, 2] > 0)
    off = moved[:, :2] / np.where(ahead, moved[:, 2], 1.0)[:, None] - seen[:, :2]
    off_px = np.hypot(camera.fx * off[:, 0], camera.fy * off[:, 1])
    return np.where(ahead & (parallax > np.sin(np.deg2rad(LEAST_PARALLAX_DEG))) & (off_px < MOST_OFF_PX), z, 0.0)


def _rays(features: Features) -> Matrix:
    """Return the direction [M, 3] of each feature, with z = 1."""
    (u, v), c = features.points.T.astype(np.float64), features.camera
    return np.stack([(u - c.cx) / c.fx, (v - c.cy) / c.fy, np.ones(len(u))], 1)


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
    image = FeatureImage(LateDetail(frame), working.depth_m, working.camera)
    return image, np.asarray(frame.T_given_camera)


def open_scene(path: str | Path, config: Config | None = None, given: Collection[str] = ()) -> tuple[Source, Config]:
    """Open a sequence; return it with the settings for its scene, which differ from `config` outdoors and for stereo.

    given: names of settings that keep their values, as in ["input.max_depth_m"]. With known poses, an
    `input.poses_scale` of 0 is measured, or the scale of predicted depth. Raises as `open_source`.
    """
    config = config or Config()
    source, asked = open_source(path, config.input), config.input
    if asked.poses and not (asked.poses_scale and (asked.predicted_scale or not source.predicted_depth)):
        config = with_measured_scale(source, config)
    if config.input != asked:
        source = open_source(path, config.input)
    return source, config_of_facts(scene_facts(source), config, given)


def scene_facts(source: Source) -> dict[str, Any]:
    """Return what run.json keeps of the scene: its size, the noise of depth, the sensor, and if a network
    predicted depth this fact."""
    facts: dict[str, Any] = {
        "scene_scale": source.scene_scale, "depth_noise_per_m": source.depth_noise_per_m, "sensor": source.sensor
    }  # fmt: skip
    return facts | ({"predicted_depth": True} if source.predicted_depth else {})


def config_of_facts(facts: Mapping[str, Any], config: Config, given: Collection[str] = ()) -> Config:
    """Return the settings that a run with these facts (run.json) used if it was asked for `config`."""
    noise, predicted = facts.get("depth_noise_per_m"), bool(facts.get("predicted_depth"))
    return for_scene(config, facts.get("scene_scale") or 1.0, noise, given, facts.get("sensor"), predicted)
