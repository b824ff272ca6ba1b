"""How far refinement moves keyframes: as far as their poses may be wrong."""

from dataclasses import replace

import numpy as np

from sigmasplat.config import FinalConfig
from sigmasplat.data.selection import evenly_spread
from sigmasplat.graph.path_covariance import PathCovariance

SHARE = 0.5
"""The reach as a share of the stated standard deviation of keyframe positions. It is about 1 mm with exact depth: with
1 cm, refinement would double the error of such a path."""
KEYFRAMES_MOST = 40
"""The standard deviation is the median of at most this many keyframes, evenly spread: each one costs milliseconds."""


def reaching(final: FinalConfig, path: PathCovariance) -> FinalConfig:
    """Return the settings of a refinement with a reach that follows from the errors of the path (ours).

    With `pose_reach_most_m`, the reach is `SHARE` times the median standard deviation of keyframe positions, from
    `pose_reach_m` to `pose_reach_most_m`. The learning rates of poses grow in the same proportion. If tracking has
    estimated the errors of less than half of the hops, as tracking by descent does, the reach stays `pose_reach_m`.
    """
    if not final.pose_reach_m or final.pose_reach_most_m <= final.pose_reach_m or not is_estimated(path):
        return final
    reach_m = min(max(SHARE * position_std_m(path), final.pose_reach_m), final.pose_reach_most_m)
    factor = reach_m / final.pose_reach_m
    return replace(
        final,
        pose_reach_m=reach_m,
        lr_pose_translation=factor * final.lr_pose_translation,
        lr_pose_rotation=factor * final.lr_pose_rotation,
    )


def is_estimated(path: PathCovariance) -> bool:
    """Return whether tracking has estimated the errors of at least half of the hops between keyframes."""
    submap = path.keyframe_submap
    is_hop = np.concatenate([[False], submap[1:] == submap[:-1]])  # the first keyframe of a submap has none
    known = np.asarray(np.isfinite(path.hops.covariance).all((1, 2)))
    return bool(is_hop.any()) and float(known[is_hop].mean()) >= 0.5


def position_std_m(path: PathCovariance) -> float:
    """Return the median standard deviation of keyframe positions relative to the first camera, m: the square root of
    the sum over the axes."""
    submaps = path.keyframe_submap
    numbers = np.arange(len(submaps)) - np.searchsorted(submaps, submaps)  # of each keyframe in its submap
    rows = evenly_spread(range(len(submaps)), KEYFRAMES_MOST)
    covariances = (path.of_keyframe(int(submaps[row]), int(numbers[row])) for row in rows)
    return float(np.median([np.sqrt(np.trace(covariance[:3, :3])) for covariance in covariances]))
