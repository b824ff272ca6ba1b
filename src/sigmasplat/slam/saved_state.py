"""The state of SLAM between two frames as one tree, to save and to restore."""

from typing import Any

from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.data.frame import Detail, Photo, PosePrior
from sigmasplat.data.poses import Column, KeyframePoses, Places, Poses
from sigmasplat.data.relative_pose import Alignments, Edges, RelativePose, TrackedHops
from sigmasplat.data.submap import Picture
from sigmasplat.fit.adam import VectorAdam
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.graph.candidates import DescribedSubmaps
from sigmasplat.graph.closer import LoopCloser, PendingSearch
from sigmasplat.graph.confidence import Confidence
from sigmasplat.graph.growing_graph import GrowingGraph
from sigmasplat.graph.loops import Loop, Loops
from sigmasplat.mapping.mapper import Mapper, SecondHalf
from sigmasplat.mapping.validation_views import ValidationView, ValidationViews
from sigmasplat.slam.results import Step, Steps
from sigmasplat.slam.slam import Slam
from sigmasplat.tracking.drift import Drift
from sigmasplat.tracking.feature_image import FeatureImage
from sigmasplat.tracking.moving.depth_history import DepthHistory, RememberedDepth
from sigmasplat.tracking.moving.dynamic_detector import DynamicDetector
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask
from sigmasplat.tracking.pose_validation import TrackingStatistics
from sigmasplat.tracking.predicted_depth_fit import DepthFit, DepthShape
from sigmasplat.tracking.recovery import Recovery
from sigmasplat.tracking.relocaliser import Relocaliser
from sigmasplat.tracking.tracker import Tracker

CLASSES: tuple[type, ...] = (
    Alignments, Atlas, Camera, Column, Confidence, DepthFit, DepthHistory, DepthShape, DescribedSubmaps, Detail, Drift,
    DynamicDetector, DynamicMask, Edges, FeatureImage, GaussianField, GrowingGraph, Keyframe, KeyframePoses, Loop,
    LoopCloser, Loops, Mapper, PendingSearch, Photo, Picture, Places, PosePrior, Poses, Pyramid, Recovery, Reference,
    RelativePose,
    Relocaliser, RememberedDepth, Rows, SecondHalf, Step, Steps, Target, TrackedHops, Tracker, TrackingStatistics,
    ValidationView, ValidationViews, VectorAdam,
)  # fmt: skip
"""The classes that a state may contain."""


REMEMBERED = (
    "atlas", "mapper", "tracker", "drift", "steps", "keyframe_indices", "closer", "recovery", "relocaliser",
    "confidence", "validation_views", "graph",
)  # fmt: skip
"""The attributes of `Slam` that change from frame to frame, except its random numbers."""


def fixed(slam: Slam) -> dict[str, Any]:
    """Return the objects that a state refers to but does not contain: settings, store, view, random numbers, and the
    extractor of features, if there is one."""
    c = slam.config
    settings = {"config": c, "tracking": c.tracking, "recovery": c.recovery, "moving": c.moving}
    extractor = {} if slam.extractor is None else {"extractor": slam.extractor}
    return settings | extractor | {"store": slam.store, "view": slam.view, "random": slam.random}


def state_of(slam: Slam) -> dict[str, Any]:
    """Return the state, when its submaps are on the disk; write it before the next step. At least one frame must have
    been processed."""
    slam.settle()
    remembered = {name: getattr(slam, name) for name in REMEMBERED}
    return {"numbers": slam.random.bit_generator.state, "submaps": len(slam.store)} | remembered


def restore(slam: Slam, state: dict[str, Any]) -> None:
    """Restore a state, read with `fixed(slam)`, in a system that is `prepare`d for the same camera."""
    slam.random.bit_generator.state = state["numbers"]
    for name in REMEMBERED:
        setattr(slam, name, state[name])
    slam.keep_on_disk()
