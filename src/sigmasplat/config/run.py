"""Settings of the whole run: recovery, moving things, the surface, uncertainty, and the real-time clock."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from sigmasplat.config.ranges import Count, Section


@dataclass(frozen=True)
class RecoveryConfig(Section, name="recovery"):
    """Relocalisation of a lost camera, and new maps if it is not found (ours)."""

    relocalise: bool = True
    """Whether a lost camera is searched for in the keyframes of all submaps, by features; off = only near the last
    pose, every tracked frame may be mapped, and no new map begins (papers)."""
    candidates: ClassVar[int] = 8
    """Number of keyframes, those with the most matches, from which the pose of a lost camera is computed and
    verified."""

    @property
    def steady_frames(self) -> int:
        """After the camera was lost, nothing is mapped until this many frames in a row have been tracked without doubt;
        0 = off (papers)."""
        return 2 if self.relocalise else 0

    @property
    def new_map_after(self) -> int:
        """A new map begins after this many lost frames in a row; frames without depth or with a flat image do not
        count. It joins the old map when a place is recognised; 0 = never."""
        return 20 if self.relocalise else 0


@dataclass(frozen=True)
class MovingConfig(Section, name="moving"):
    """Things that move are left out of tracking and of the map (ours)."""

    find: bool = True  # up to 3 % of the time where nothing moves (benchmarks/search_cost.py)
    """Whether keyframes are compared with each other: what one shows in space that another has seen to be free is
    masked, and splats there are removed. Off = only what is nearer than the newest keyframe is masked, in tracking with
    `tracking.verify` (papers: nothing)."""
    still_frames: ClassVar[int] = 30
    """What was found to move and then stays in place for this many frames becomes part of the map again; 0 = never."""
    compared: ClassVar[int] = 3
    """Number of earlier keyframes of the submap that a new keyframe is compared with."""
    carve_votes: ClassVar[int] = 3
    """A splat is removed if this many keyframes see through its place and none shows a surface there."""


@dataclass(frozen=True)
class SurfaceConfig(Section, name="surface"):
    """The mesh of a finished run. Raises ConfigError on invalid values."""

    depth: Literal["map", "map+sensor"] = "map+sensor"
    """Depth that is fused at each keyframe: map = rendered from its submap (VarSplat §7); map+sensor = rendered from
    the final map, and the readings of the keyframe, weighted by their variances (ours)."""


@dataclass(frozen=True)
class UncertaintyConfig(Section, name="uncertainty"):
    """Calibration of the variance that a map predicts for its colour and depth (ours). Raises ConfigError on invalid
    values."""

    probes: Count = 4
    """Number of probe views that each submap keeps: well-tracked frames that are not keyframes. The map is not fitted
    to them; the predicted variance is calibrated on them after the last frame. 0 = no predicted variance."""


@dataclass(frozen=True)
class RealTimeConfig(Section, name="realtime"):
    """Live cameras and `run --realtime`: when frames become keyframes, and how much mapping may wait. Raises
    ConfigError on invalid values."""

    live: bool = True
    """Whether live cameras run in real time; off = a frame waits until the one before it is mapped."""
    keyframe_deg: ClassVar[float] = 5.0
    """A frame becomes a keyframe when the image has moved by this angle since the last keyframe: rotation plus
    translation divided by the mean depth. There are not more keyframes than in a recording (`mapping.every`), because
    each adds an error to the path, unless the overlap is low. 0 = by the number of frames, as in a recording."""
    waiting_most: ClassVar[int] = 24
    """Maximum number of keyframes that wait for mapping; while as many wait, no frame becomes a keyframe."""
    spare_iterations: ClassVar[int] = 60
    """Maximum number of additional iterations after a keyframe is mapped, while no other keyframe waits; 0 = none."""
