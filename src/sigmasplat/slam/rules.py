"""Decide: small questions about a run, answered yes or no, or with which ones."""

from collections.abc import Iterator, Sequence
from typing import TypeVar

import numpy as np

from sigmasplat.fit.pose import PoseFit

Item = TypeVar("Item")


def is_keyframe(frames_since: int, every: int, overlap: float, overlap_below: float) -> bool:
    """Tell whether a frame is mapped: so many frames after the last one (VarSplat §2), or when too little is shared."""
    return frames_since >= every or overlap < overlap_below


def is_lost(fit: PoseFit, least_agreement: float, least_share: float) -> bool:
    """Tell whether a pose is not to be believed: the surfaces in common disagree, or there are too few of them."""
    return fit.agreement < least_agreement or fit.agreement * fit.overlap < least_share


def jumped(value: float, history: Sequence[float], factor: float) -> bool:
    """Tell whether a loss exceeds `factor` times the median of its recent past (VarSplat §3, re-initialisation)."""
    return len(history) >= 5 and value > factor * float(np.median(history[-50:]))


def draw_keyframes(
    keyframes: Sequence[Item], iterations: int, newest_probability: float, history: int, random: np.random.Generator
) -> Iterator[Item]:
    """Draw one keyframe per iteration: the newest with the given probability, else any (VarSplat §2).

    history > 0 limits the others to the latest so many.
    """
    older = list(keyframes[:-1])[-history:] if history else list(keyframes[:-1])
    for _ in range(iterations):
        if not older or random.random() < newest_probability:
            yield keyframes[-1]
        else:
            yield older[int(random.integers(len(older)))]
