"""Decide: small questions about a run, answered yes or no, or with which ones."""

from collections.abc import Iterator, Sequence
from typing import TypeVar

import numpy as np

from sigmasplat.fit.pose import PoseFit

Item = TypeVar("Item")


def is_keyframe(index: int, every: int) -> bool:
    """Tell whether a frame is mapped: every so many frames, the first always (VarSplat §2)."""
    return index % max(every, 1) == 0


def is_lost(fit: PoseFit, least_share: float) -> bool:
    """Tell whether the map explains too little of what the sensor sees for the pose to be believed."""
    return fit.agreement * fit.overlap < least_share


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
