"""Estimate the probability that the pose of a frame is off by more than 5 cm.

Either of two things makes it so: the fit of this frame is wrong (`tracking.pose_validation`), or the path to its submap
is, whose spread grows with every hop between keyframes and shrinks with every loop. `benchmarks/failure_probability.py`
fits how probable the second is to disturbed recordings with known truth.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from sigmasplat.data.trajectory import APART, LOST
from sigmasplat.fit.compare import Comparison
from sigmasplat.graph.loops import Loop
from sigmasplat.tracking.pose_validation import p_wrong
from sigmasplat.types import Matrix

LOOP_STD_M = 0.01
"""Standard deviation of the position that a loop gives, in a room."""
EVEN_STD_M = 38.0
"""A place is as likely off as not if this is the standard deviation of its position; the odds are in proportion. The
value is large because these deviations, of hops alone, are far too careful: after one hop of unknown error, a metre."""
COMPARED = [each.name for each in fields(Comparison)]
CERTAIN = {LOST: 0.85, APART: 0.99}
"""Fixed probabilities: of a lost frame (the share of lost frames whose guess is off), and of a frame whose place in the
world is not known."""


@dataclass(eq=False)
class Confidence:
    """spread_m: standard deviation of each submap's position in its component; parents: the submap that each began at,
    None: it began a component."""

    spread_m: list[float] = field(default_factory=list)
    parents: list[int | None] = field(default_factory=list)

    def begun(self, parent: int | None, position_m: float) -> None:
        """Add a submap: at position_m (standard deviation, m) from its parent, or the first of a component."""
        self.parents.append(parent)
        self.spread_m.append(0.0 if parent is None else math.hypot(self.spread_m[parent], position_m))

    def joined(self, members: Sequence[int], submap: int, kept: int, link_m: float) -> None:
        """Add the path to the component that the submaps `members` join: from `submap`, one of them, by a link of
        link_m (standard deviation, m) to submap `kept`."""
        path_m = math.hypot(self.spread_m[kept], link_m, self.spread_m[submap])
        for s in members:
            self.spread_m[s] = math.hypot(path_m, self.spread_m[s])

    def closed(self, loops: Sequence[Loop], scene_scale: float = 1.0) -> None:
        """Take the loops of a finished submap into account, also for the submaps that began at it before its loops were
        known; scene_scale: size of the scene relative to a room."""
        for loop in loops:
            if loop.accepted:
                ours, theirs = loop.query, math.hypot(self.spread_m[loop.database], LOOP_STD_M * scene_scale)
                lower = max(0.0, self.spread_m[ours] ** 2 - theirs**2)
                for s in (ours, *(s for s, parent in enumerate(self.parents) if parent == ours)):
                    self.spread_m[s] = math.sqrt(max(0.0, self.spread_m[s] ** 2 - lower))

    def position_std_m(self, in_submap_m: float) -> float:
        """Return the standard deviation of the camera's position in its component, given that in its submap, metres."""
        return math.hypot(self.spread_m[-1], in_submap_m)

    def probability(self, state: str, tracking: Mapping[str, float]) -> float:
        """Return the probability that the pose of the newest frame is off by more than 5 cm.

        tracking: values of its fit (`FrameEstimate.logged`), with position_std_m.
        """
        if state in CERTAIN:
            return CERTAIN[state]
        std_m = tracking.get("position_std_m", 0.0)
        return 1.0 - (1.0 - hop_wrong(tracking)) * EVEN_STD_M / (EVEN_STD_M + std_m)


def compared(tracking: Mapping[str, float]) -> Comparison | None:
    """Return the comparison of surfaces among the values of a fit, if it was made."""
    seen: dict[str, Any] = {name: tracking[name] for name in COMPARED if name in tracking}
    return Comparison(**seen) if "close" in seen else None


def hop_wrong(tracking: Mapping[str, float]) -> float:
    """Return the probability that the fit of a frame is wrong; without a comparison, by its agreement."""
    seen = compared(tracking)
    return 1.0 - tracking.get("agreement", 1.0) if seen is None else p_wrong(seen)


def std_of(information: Matrix) -> float:
    """Return the standard deviation of the position, m, from the information [6, 6] of a twist."""
    return float(np.sqrt(np.trace(np.linalg.inv(information)[:3, :3])))
