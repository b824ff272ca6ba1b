"""Choose the keyframes that are fitted together: the newest, the one before, and the most co-visible others. Keep probe
views: frames that were tracked without doubt and that the map is not fitted to."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.data.field import GaussianField
from sigmasplat.data.submap import Picture, Submap
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.render.view import View
from sigmasplat.tracking.descriptors import similarity
from sigmasplat.types import Matrix

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
    best = np.lexsort((-np.arange(len(older)), -SCORES[by](keyframes[-1], older)))[: size - 2]
    return window + [older[k] for k in best]


def dominating(view: View, splats: GaussianField) -> Ids:
    """Return the sorted ids of splats that dominate a pixel in the view's last forward pass with layers."""
    rows = view.layers.dominant_id[: view.camera.height, : view.camera.width]
    there = torch.zeros(len(splats), dtype=torch.bool, device=rows.device)
    there[rows[rows >= 0].long()] = True
    return np.sort(splats.ids[there.to(splats.ids.device)].cpu().numpy())


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
    """Draw a keyframe for each iteration: the newest with this probability, else a random older one (VarSplat §2)."""
    *older, newest = keyframes
    for _ in range(iterations):
        yield [newest if not older or random.random() < newest_probability else older[int(random.integers(len(older)))]]


@dataclass(frozen=True, eq=False)
class ValidationView:
    """A frame that is not a keyframe: its number, its pose relative to the keyframe with number `keyframe` in the
    submap (T_keyframe_camera [4, 4]), and its images."""

    index: int
    keyframe: int
    T_keyframe_camera: Matrix
    picture: Picture


@dataclass(eq=False)
class ValidationViews:
    """The probe views of the active submap: at most `most`, one per keyframe, spread over the submap.

    every: frames between keyframes. The number of frames from a keyframe to its probe varies, so that probes are as
    near to keyframes as frames are on average. The farthest frames have larger errors than most.
    """

    most: int
    every: int
    kept: list[ValidationView] = field(default_factory=list)

    def offer(self, index: int, keyframe: int, since: int, T_keyframe_camera: Matrix, target: Target) -> None:
        """Keep a frame if it is nearer to the wanted distance from its keyframe than the one kept; since: frames since
        the keyframe."""
        if not self.wants(keyframe, since):
            return
        self.kept = [probe for probe in self.kept if probe.keyframe != keyframe]
        self.kept.append(ValidationView(index, keyframe, T_keyframe_camera, target.picture()))
        if len(self.kept) > self.most:
            self.kept.pop(self._most_crowded())

    def wants(self, keyframe: int, since: int) -> bool:
        """Return whether a frame may be kept, `since` frames after a keyframe."""
        return bool(self.most) and since <= 1 + keyframe % max(1, self.every - 1)

    def _most_crowded(self) -> int:
        """Return which probe to drop: the one nearest to its neighbours, but the newest only if it is the only one."""
        at = [self.kept[0].index - self.every, *(probe.index for probe in self.kept)]
        gaps = [at[k + 2] - at[k] if k + 2 < len(at) else np.inf for k in range(len(self.kept))]
        return int(np.argmin(gaps))

    def of(self, submap: Submap) -> tuple[Submap, list[Picture]]:
        """Return a finished submap with these probe views, and their images."""
        if not self.kept:
            return submap, []
        poses = np.stack([submap.T_submap_camera[p.keyframe] @ p.T_keyframe_camera for p in self.kept])
        frames = tuple(probe.index for probe in self.kept)
        return replace(submap, probe_frames=frames, T_submap_probe=poses), [probe.picture for probe in self.kept]
