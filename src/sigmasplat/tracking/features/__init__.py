"""Find sparse features, match them, and compute a pose from matches with depth."""

from sigmasplat.config import Config
from sigmasplat.tracking.features.base import (
    FEATURE_WIDTH,
    VOTE_RATIO,
    Extractor,
    Features,
    Landmarks,
    depth_readings,
    landmarks_of,
    matched_by_distance,
)
from sigmasplat.tracking.features.pose import PnP, pose_from_landmarks

__all__ = [
    "FEATURE_WIDTH", "VOTE_RATIO", "Extractor", "Features", "Landmarks", "PnP", "depth_readings", "extractor_of",
    "landmarks_of", "matched_by_distance", "pose_from_landmarks",
]  # fmt: skip


def extractor_of(config: Config) -> Extractor | None:
    """Return the extractor of a run; None if nothing in it uses features."""
    return Extractor() if config.tracking.features or config.recovery.relocalise else None
