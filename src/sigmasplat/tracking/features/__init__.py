"""Find sparse features, match them, and compute a pose from matches with depth."""

from collections.abc import Callable

import numpy as np

from sigmasplat.config import Config, FeatureConfig
from sigmasplat.tracking.features.base import (
    Extractor,
    Features,
    Landmarks,
    Pairs,
    depth_readings,
    landmarks_of,
    matched_by_distance,
)
from sigmasplat.tracking.features.kinds import Orb, Sift, XFeat
from sigmasplat.tracking.features.pose import PnP, pose_from_landmarks

__all__ = [
    "Extractor", "Features", "Landmarks", "PnP", "depth_readings", "extractor_of", "landmarks_of", "make_extractor",
    "matches_by_descriptor", "pose_from_landmarks",
]  # fmt: skip

RATIO = 0.85
"""A match counts if its descriptor distance is below this multiple of the distance to the second-best candidate."""


def matches_by_descriptor(a: Features, b: Features, extractor: Extractor) -> Pairs:
    """Return matches [M, 2] by descriptors alone, also for kinds whose own matcher is slow."""
    if a.descriptors.dtype == np.uint8:
        return extractor.match(a, b)
    return matched_by_distance(a.descriptors.astype(np.float32), b.descriptors.astype(np.float32), RATIO)


def extractor_of(config: Config) -> Extractor | None:
    """Return the extractor of a run; None if nothing in it uses features."""
    wanted = config.tracking.features or config.recovery.relocalise
    return make_extractor(config.features) if wanted else None


def make_extractor(config: FeatureConfig) -> Extractor:
    """Return the extractor of a kind. Raises ConfigError if its packages are not installed."""
    kinds: dict[str, Callable[[FeatureConfig], Extractor]] = {"sift": Sift, "orb": Orb, "xfeat": XFeat}
    return kinds[config.kind](config)
