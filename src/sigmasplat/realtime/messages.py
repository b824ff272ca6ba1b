"""What the two clocks hand to each other: tracked frames one way, snapshots of the map the other way.

A message is never changed after it was handed over. It holds copies of everything that its sender changes later.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor

from sigmasplat.fit.align import Alignment
from sigmasplat.fit.compare import Comparison
from sigmasplat.fit.target import Target
from sigmasplat.graph.loops import Loops
from sigmasplat.graph.newest_covariance import NO_ERRORS, PoseErrors
from sigmasplat.slam.listeners import Correction
from sigmasplat.slam.results import Step, SubmapState
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask
from sigmasplat.tracking.prepared_frame import PreparedFrame, TrackedKeyframe
from sigmasplat.types import Matrix

Poses = Mapping[int, Matrix]
"""T_submap_camera [4, 4] of frames, by the number of the frame."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The active map as tracking needs it, after a keyframe was mapped or the camera was found.

    frame: number of the frame that was mapped or found; poses: of this frame and of the newest keyframe, in the active
    submap; state: how the frame came into the map, "" if it was tracked; params [N, 17]: rows of the splats; keyframe:
    reference of the next frames; spread_m: standard deviation of the submap's position; loops:
    all pairs tried so far; searched: number of the last frame that was searched for in the whole map; seconds: of the
    work since the snapshot before; errors: of poses relative to the newest keyframe, if the system computes them;
    correction: of earlier poses since the snapshot before, if a function of the caller wants it.
    """

    frame: int
    newest: int
    poses: Poses
    state: str
    params: Tensor
    keyframe: TrackedKeyframe
    active: SubmapState
    spread_m: float
    loops: Loops = field(default_factory=Loops)
    searched: int = -1
    seconds: float = 0.0
    errors: PoseErrors = NO_ERRORS
    correction: Correction | None = None


@dataclass(frozen=True, eq=False)
class Search:
    """A frame to be found in the whole map; comparison: of its doubtful pose, None if it is lost; apart: whether a new
    map begins if it is not found."""

    seen: PreparedFrame
    comparison: Comparison | None = None
    apart: bool = False


@dataclass(frozen=True, eq=False)
class Offer:
    """A keyframe for the map; alignment: to the keyframe before it; front: what is in front of the scene."""

    seen: PreparedFrame
    alignment: Alignment | None = None
    front: DynamicMask | None = None
    exposure: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A tracked frame: its number; its step as reported; its pose T_submap_camera [4, 4] and those of the keyframes
    that it may be placed by, all in the coordinates of the tracker at that time.

    based_on: the frame of the snapshot that it was tracked with, −1 = none; offer: if it is a keyframe; search: if it
    is searched for; shown: its images if it may become a validation view.
    """

    number: int
    step: Step
    T_submap_camera: Matrix
    poses: Poses
    based_on: int = -1
    offer: Offer | None = None
    search: Search | None = None
    shown: Target | None = None
