"""Settings for things that move."""

from dataclasses import dataclass

from sigmasplat.config.ranges import AtLeastOne, Count, Section


@dataclass(frozen=True)
class MovingConfig(Section, name="moving"):
    """Things that move are left out of tracking and of the map (ours)."""

    find: bool = True  # up to 3 % of the time where nothing moves (benchmarks/search_cost.py)
    """Whether keyframes are compared with each other: what one shows in space that another has seen to be free is
    masked, and splats there are removed. Off = only what is nearer than the newest keyframe is masked, in tracking with
    `tracking.verify` (papers: nothing)."""
    still_frames: Count = 30
    """What was found to move and then stays in place for this many frames becomes part of the map again; 0 = never."""
    compared: AtLeastOne = 3
    """Number of earlier keyframes of the submap that a new keyframe is compared with."""
    carve_votes: AtLeastOne = 3
    """A splat is removed if this many keyframes see through its place and none shows a surface there."""
