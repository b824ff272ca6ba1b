"""Estimate the probability that the pose of a frame is off by more than 5 cm.

Either of two things makes it so: the fit of this frame is wrong (`tracking.pose_validation`), or the place of the
keyframe that it was fitted to is. A place is as doubtful as the hops that led to it, unless images confirm another way
there: an alignment to an earlier keyframe, or a search of the whole map. What looks the same from several places, as a
tiled wall does, confirms none of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from sigmasplat.data.trajectory import APART, LOST
from sigmasplat.fit.align import align
from sigmasplat.fit.compare import COARSE, SLIDE, Comparison, compare, held
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.tracking.pose_validation import DOUBTFUL, HELD_FLAT, LOST as LIKELY_WRONG, SURE, p_wrong
from sigmasplat.types import Matrix

COMPARED = [each.name for each in fields(Comparison)]
CERTAIN = {LOST: 0.85, APART: 0.99}
"""Fixed probabilities: of a lost frame (the share of lost frames whose guess is off), and of a frame whose place in the
world is not known."""
SHIFTS = (1 / 16, 1 / 8, 3 / 16, 1 / 4)
"""A keyframe is aligned to itself from places beside it: those that move its image by these shares of its width, as a
camera in a hand does from frame to frame."""
NEARLY = 2.0
"""Another place is as good if the pose there is at most so many times as likely wrong as at the own one."""


@dataclass(eq=False)
class Confidence:
    """doubts: the probability of each keyframe that its place in its component is wrong; newest: the same of the
    keyframe that frames are fitted to now."""

    doubts: list[float] = field(default_factory=list)
    newest: float = 0.0

    def begins(self, place: int | None = None) -> None:
        """Continue at keyframe number `place`, where images confirm the camera; None: a component begins."""
        self.newest = self.doubts[place] if place is not None and place < len(self.doubts) else 0.0

    def placed(self, number: int, wrong: float, confirmed: Sequence[int], alike: int = 1) -> None:
        """Add a keyframe; wrong: the probability that the hop to it is wrong; confirmed: numbers of the earlier
        keyframes that it was aligned to; alike: how many places look like its own. A hop that is not doubtful adds
        nothing: there are thousands of them."""
        by_hop = self.newest if wrong <= DOUBTFUL else either(self.newest, wrong)
        ways = [by_hop] if alike > 1 else [by_hop, *(self.doubts[k] for k in confirmed)]
        self.newest = either(min(ways), 1.0 - 1.0 / alike)
        self.doubts[number:] = [*[0.0] * (number - len(self.doubts)), self.newest]


def off_probability(state: str, tracking: Mapping[str, float]) -> float:
    """Return the probability that the pose of a frame is off by more than 5 cm; tracking: values of its fit
    (`FrameEstimate.logged`). Without a comparison, the fit is judged by its agreement."""
    seen = compared(tracking)
    wrong = 1.0 - tracking.get("agreement", 1.0) if seen is None else p_wrong(seen)
    return CERTAIN[state] if state in CERTAIN else either(tracking.get("doubt", 0.0), wrong)


def either(p: float, q: float) -> float:
    """Return the probability that one of two independent things is wrong, or both."""
    return 1.0 - (1.0 - p) * (1.0 - q)


def places_alike(image: Pyramid) -> int:
    """Return from how many places, its own and those beside, above and below it, a camera would see the same as in an
    image: the judge of poses would accept them, or finds them nearly as good. They are sought where depth alone does
    not hold the pose."""
    small, c = image.coarse(COARSE), image.cameras[0]
    found = align(small, small, np.eye(4), 0)
    if held(image, image, found, weight_color=0.0) >= HELD_FLAT:
        return 1
    holds = held(image, image, found)

    def judged(T: Matrix) -> float:
        return p_wrong(replace(compare(image, image, T), held=holds))

    most = max(SURE, NEARLY * judged(np.eye(4)))

    def is_alike(axis: int, share: float) -> bool:
        T = np.eye(4)
        T[axis, 3] = share * found.depth_m * c.width / c.fx
        T = align(small, small, T).T_live_reference
        if judged(T) > LIKELY_WRONG:
            return False
        T = align(image, image, T).T_live_reference
        moved_m = np.linalg.norm(image.points @ (T[:3, :3] - np.eye(3)).T + T[:3, 3], axis=1)
        return float(np.median(moved_m)) > SLIDE * found.depth_m and judged(T) < most

    return 1 + 2 * sum(any(is_alike(axis, share) for share in SHIFTS) for axis in (0, 1))


def compared(tracking: Mapping[str, float]) -> Comparison | None:
    """Return the comparison of surfaces among the values of a fit, if it was made."""
    seen: dict[str, Any] = {name: tracking[name] for name in COMPARED if name in tracking}
    return Comparison(**seen) if "close" in seen else None
