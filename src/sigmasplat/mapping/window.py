"""Choose the keyframes that are fitted together: the newest, the one before, and the most co-visible others."""

from collections.abc import Callable, Iterator, Sequence
from typing import Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.errors import SigmaSplatError
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.view import View
from sigmasplat.tracking.descriptors import similarity

Item = TypeVar("Item")

Ids = NDArray[np.int64]
Scores = NDArray[np.float64]

GRID = 40
"""Rows and columns of the grid of depth readings in the newest keyframe (1600 pixels, as in CG-SLAM's code)."""
HIDDEN_RELATIVE, HIDDEN_M = 0.05, 0.05
"""A point is occluded if it is farther than the other camera's reading by more than the sum of both."""


def choose_window(
    keyframes: Sequence[Keyframe], size: int, by: Literal["splats", "frustum", "descriptor"]
) -> list[Keyframe]:
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


def _by_readings(newest: Keyframe, others: Sequence[Keyframe]) -> Scores:
    points = _readings(newest)
    return np.array([_share_seen(points, keyframe) for keyframe in others])


def _by_descriptor(newest: Keyframe, others: Sequence[Keyframe]) -> Scores:
    return similarity(np.stack([_descriptor(keyframe) for keyframe in others]), _descriptor(newest)[None]).ravel()


SCORES: dict[str, Callable[[Keyframe, Sequence[Keyframe]], Scores]] = {
    "splats": _by_splats,
    "frustum": _by_readings,
    "descriptor": _by_descriptor,
}
"""Co-visibility of keyframes with the newest one, by method."""


def _readings(keyframe: Keyframe) -> NDArray[np.float64]:
    """Return the depth readings on a grid of pixels as points in the world [n, 3], metres."""
    camera = keyframe.target.camera
    rows, columns = (np.unique((np.arange(GRID) + 0.5) * n // GRID).astype(int) for n in (camera.height, camera.width))
    grid = np.ix_(rows, columns)
    depth = keyframe.target.depth_image.numpy()[grid].astype(np.float64)
    points = (camera.rays()[grid] * depth[..., None])[depth > 0]
    T = keyframe.T_world_camera
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _share_seen(points: NDArray[np.float64], keyframe: Keyframe) -> float:
    """Return the share of points [n, 3] in the world that a keyframe sees: inside its image and not occluded."""
    T, camera, depth_m = se3.inverse(keyframe.T_world_camera), keyframe.target.camera, keyframe.target.depth_image
    x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
    ahead = z > 0
    x, y, z = x[ahead], y[ahead], z[ahead]
    u = np.floor(camera.fx * x / z + camera.cx + 0.5)
    v = np.floor(camera.fy * y / z + camera.cy + 0.5)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    reading = depth_m.numpy()[v[inside].astype(int), u[inside].astype(int)]
    clear = (reading == 0) | (z[inside] <= reading * (1.0 + HIDDEN_RELATIVE) + HIDDEN_M)
    return int(clear.sum()) / max(len(points), 1)


def _seen(keyframe: Keyframe) -> Ids:
    if keyframe.visible_ids is None:
        raise _nothing(keyframe, "list of visible splats", "splats")
    return keyframe.visible_ids


def _descriptor(keyframe: Keyframe) -> NDArray[np.float32]:
    if keyframe.descriptor is None:
        raise _nothing(keyframe, "descriptor", "descriptor")
    return keyframe.descriptor


def _nothing(keyframe: Keyframe, missing: str, by: str) -> SigmaSplatError:
    return SigmaSplatError(
        f"keyframe {keyframe.index} has no {missing}, which mapping.covisibility={by} needs; "
        "use mapping.covisibility=frustum, which needs depth only"
    )


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
