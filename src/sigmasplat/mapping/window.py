"""Choose the keyframes that are fitted together: the newest, the one before, and the most co-visible others."""

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.data.field import GaussianField
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.view import View
from sigmasplat.tracking.descriptors import similarity

Item = TypeVar("Item")

Ids = NDArray[np.int64]
Scores = NDArray[np.float64]


def choose_window(keyframes: Sequence[Keyframe], size: int, by: str) -> list[Keyframe]:
    """Return the newest keyframe, the one before it, then the most co-visible others, best first (CG-SLAM §7).

    keyframes: in the order of time; size ≥ 1: the most to return. Between equal scores the later keyframe wins.
    """
    latest, older = list(keyframes[-2:]), keyframes[:-2]
    window = latest[::-1][:size]
    if size <= 2 or not older:
        return window
    scores = SCORES[by](keyframes[-1], older)
    best = np.lexsort((-np.arange(len(older)), -scores))[: size - 2]
    return window + [older[k] for k in best]


def dominating(view: View, field: GaussianField) -> Ids:
    """Return the sorted `field.ids` of splats that dominate a pixel in the view's last forward pass with layers."""
    rows = view.layers.dominant_id[: view.camera.height, : view.camera.width]
    there = torch.zeros(len(field), dtype=torch.bool, device=rows.device)
    there[rows[rows >= 0].long()] = True
    return np.sort(field.ids[there.to(field.ids.device)].cpu().numpy())


def covisible_splats(newest: Ids, others: Sequence[Ids]) -> Scores:
    """Return the share of the newest keyframe's splats that each other keyframe sees too; ids are ≥ 0 and sorted."""
    scores = np.zeros(len(others))
    if len(newest) == 0:
        return scores
    there = np.zeros(newest[-1] + 1, bool)
    there[newest] = True
    for k, ids in enumerate(others):
        known = ids[: np.searchsorted(ids, newest[-1], side="right")]
        scores[k] = np.count_nonzero(there.take(known))
    return scores / len(newest)


def _by_splats(newest: Keyframe, others: Sequence[Keyframe]) -> Scores:
    seen = [keyframe.visible_ids for keyframe in (newest, *others) if keyframe.visible_ids is not None]
    assert len(seen) == len(others) + 1, "a window by splats needs the splats that each keyframe sees"
    return covisible_splats(seen[0], seen[1:])


def _by_descriptor(newest: Keyframe, others: Sequence[Keyframe]) -> Scores:
    known = [keyframe.descriptor for keyframe in (newest, *others) if keyframe.descriptor is not None]
    assert len(known) == len(others) + 1, "a window by descriptors needs that of each keyframe"
    return similarity(np.stack(known[1:]), known[0][None]).ravel()


SCORES: dict[str, Callable[[Keyframe, Sequence[Keyframe]], Scores]] = {
    "splats": _by_splats,
    "descriptor": _by_descriptor,
}
"""Co-visibility of keyframes with the newest one, by method."""


def draw_keyframes(
    keyframes: Sequence[Item], iterations: int, newest_probability: float, random: np.random.Generator
) -> Iterator[list[Item]]:
    """Draw a keyframe for each iteration: the newest with the given probability, else a random older one (VarSplat
    §2)."""
    *older, newest = keyframes
    for _ in range(iterations):
        yield [newest if not older or random.random() < newest_probability else older[int(random.integers(len(older)))]]
