"""Choose the keyframes that are fitted together: the newest, the one before, and the most co-visible others."""

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.data.field import GaussianField
from sigmasplat.errors import SigmaSplatError
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.view import View
from sigmasplat.tracking.descriptors import similarity

Item = TypeVar("Item")

Ids = NDArray[np.int64]
Scores = NDArray[np.float64]


def choose_window(keyframes: Sequence[Keyframe], size: int, by: str) -> list[Keyframe]:
    """Return the newest keyframe, the one before it, then the most co-visible others, best first (CG-SLAM §7).

    keyframes: in the order of time; size ≥ 1: the most to return. Between equal scores the later keyframe wins. Raises
    SigmaSplatError if a keyframe lacks the data that `by` compares.
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
    return covisible_splats(_seen(newest), [_seen(keyframe) for keyframe in others])


def _by_descriptor(newest: Keyframe, others: Sequence[Keyframe]) -> Scores:
    return similarity(np.stack([_descriptor(keyframe) for keyframe in others]), _descriptor(newest)[None]).ravel()


SCORES: dict[str, Callable[[Keyframe, Sequence[Keyframe]], Scores]] = {
    "splats": _by_splats,
    "descriptor": _by_descriptor,
}
"""Co-visibility of keyframes with the newest one, by method."""


def _seen(keyframe: Keyframe) -> Ids:
    if keyframe.visible_ids is None:
        raise _nothing(keyframe, "list of visible splats", "splats")
    return keyframe.visible_ids


def _descriptor(keyframe: Keyframe) -> NDArray[np.float32]:
    if keyframe.descriptor is None:
        raise _nothing(keyframe, "descriptor", "descriptor")
    return keyframe.descriptor


def _nothing(keyframe: Keyframe, missing: str, by: str) -> SigmaSplatError:
    return SigmaSplatError(f"keyframe {keyframe.index} has no {missing}, which a window by {by} needs")


def draw_keyframes(
    keyframes: Sequence[Item],
    iterations: int,
    newest_probability: float,
    random: np.random.Generator,
    together: int = 1,
) -> Iterator[list[Item]]:
    """Draw keyframes for each iteration: the newest with the given probability, else a random older one (VarSplat §2).

    together > 1: draw that many different keyframes, or all of them if there
    are fewer (CG-SLAM §7).
    """
    everything = list(keyframes)
    older = everything[:-1]
    for _ in range(iterations):
        if together >= len(everything) > 1:
            yield everything
            continue
        newest = not older or random.random() < newest_probability
        drawn = [len(older)] if newest else [int(random.integers(len(older)))]
        if together > 1:
            others = [i for i in range(len(everything)) if i != drawn[0]]
            drawn += [int(i) for i in random.choice(others, min(together - 1, len(others)), replace=False)]
        yield [everything[i] for i in drawn]
