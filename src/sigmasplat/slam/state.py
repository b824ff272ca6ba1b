"""Everything SLAM remembers from frame to frame, as one tree: put back, the next frame finds all as it was."""

from typing import Any

from sigmasplat.fit.adam import VectorAdam
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.model.atlas import Atlas, Place
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField, Rows
from sigmasplat.slam.drift import Drift
from sigmasplat.slam.loop_closure.candidates import SubmapDescriptor
from sigmasplat.slam.loop_closure.closer import Loop, LoopCloser
from sigmasplat.slam.loop_closure.pose_graph import Edge
from sigmasplat.slam.mapper import Mapper
from sigmasplat.slam.slam import Slam
from sigmasplat.slam.step_result import Step
from sigmasplat.slam.tracker import Tracker

CLASSES: tuple[type, ...] = (
    Atlas, Camera, Drift, Edge, GaussianField, Keyframe, Loop, LoopCloser, Mapper, Place, Pyramid, Reference, Rows,
    SubmapDescriptor, Step, Target, Tracker, VectorAdam,
)  # fmt: skip
"""What a state is made of."""


REMEMBERED = ("atlas", "mapper", "tracker", "drift", "steps", "keyframes", "closer")
"""The attributes of `Slam` that change from frame to frame, but for its random numbers."""


def fixed(slam: Slam) -> dict[str, Any]:
    """Name what a state refers to and does not hold: settings, where submaps are kept, the renderer, random numbers."""
    c = slam.config
    return {"config": c, "tracking": c.tracking, "store": slam.store, "view": slam.view, "random": slam.random}


def state_of(slam: Slam) -> dict[str, Any]:
    """Return the tree, to be read before the next step. There must have been a frame."""
    remembered = {name: getattr(slam, name) for name in REMEMBERED}
    return {"numbers": slam.random.bit_generator.state, "submaps": len(slam.store)} | remembered


def restore(slam: Slam, state: dict[str, Any]) -> None:
    """Put a tree, read with `fixed(slam)`, into a system that is `prepare`d for the same camera."""
    slam.random.bit_generator.state = state["numbers"]
    for name in REMEMBERED:
        setattr(slam, name, state[name])
