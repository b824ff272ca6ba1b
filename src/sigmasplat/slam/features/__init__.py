"""Find sparse features, match them, and compute a pose from matches with depth."""

from collections.abc import Callable

from sigmasplat.config.features import FeatureConfig
from sigmasplat.slam.features.base import Extractor, Features
from sigmasplat.slam.features.landmarks import Landmarks, depth_readings, landmarks_of
from sigmasplat.slam.features.pose import PnP, pose_from_landmarks
from sigmasplat.slam.features.sift_orb import Orb, Sift
from sigmasplat.slam.features.xfeat import XFeat

__all__ = [
    "Extractor", "Features", "Landmarks", "PnP", "depth_readings", "landmarks_of", "make_extractor",
    "pose_from_landmarks",
]  # fmt: skip


def make_extractor(config: FeatureConfig) -> Extractor:
    """Return the extractor of a kind. Raises ConfigError if its packages are not installed."""
    kinds: dict[str, Callable[[FeatureConfig], Extractor]] = {"sift": Sift, "orb": Orb, "xfeat": XFeat}
    return kinds[config.kind](config)
