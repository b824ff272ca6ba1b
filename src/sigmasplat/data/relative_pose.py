"""The measured pose of one camera or submap relative to another one."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sigmasplat.types import Matrix

Kind = Literal["hop", "odometry", "loop", "relocalisation", "join"]
"""hop: from a keyframe to the one before, as tracking found it; odometry: to the next submap at a cut; loop: judged by
the pose graph, unlike the others; relocalisation: to the place where the camera was found; join: between components."""


@dataclass(frozen=True, eq=False, slots=True)
class RelativePose:
    """T_a_b [4, 4] of submap or camera b in a, with an error: the true pose is exp(ξ) T_a_b, ξ = (ρ, φ), m and rad.

    a, b: numbers of submaps, −1 in a hop. information or covariance [6, 6]: of ξ, the one that was estimated; the other
    is nan, and so are both for the first keyframe of a submap. bias [6]: standard deviation of the error that is the
    same in all hops. A loop compares a keyframe of submap a with one of submap b: `keyframes`, counted in their
    submaps. drift [6, 6]: the part of its covariance that is the drift from the submaps' first keyframes to these two.
    """

    a: int
    b: int
    T_a_b: Matrix
    information: Matrix = field(default_factory=lambda: np.full((6, 6), np.nan))
    kind: Kind = "odometry"
    keyframes: tuple[int, int] = (0, 0)
    drift: Matrix = field(default_factory=lambda: np.zeros((6, 6)))
    covariance: Matrix = field(default_factory=lambda: np.full((6, 6), np.nan))
    bias: Matrix = field(default_factory=lambda: np.zeros(6))

    @staticmethod
    def hop(T_camera_before: Matrix, covariance: Matrix | None = None, bias: Matrix | None = None) -> "RelativePose":
        """Return the motion to a keyframe from the one before; covariance None: it is not known."""
        known = np.full((6, 6), np.nan) if covariance is None else covariance
        same = np.zeros(6) if bias is None else bias
        return RelativePose(-1, -1, T_camera_before, kind="hop", covariance=known, bias=same)

    @property
    def loop(self) -> bool:
        """Return whether the pose graph judges it."""
        return self.kind == "loop"

    @property
    def measured(self) -> Matrix:
        """Return the covariance [6, 6] of the measurement alone, without drift."""
        return np.asarray(np.linalg.inv(self.information) - self.drift)


UNKNOWN_HOP = RelativePose.hop(np.eye(4))
