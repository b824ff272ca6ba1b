"""Refine a map over all keyframes: splats and keyframe poses together (VarSplat §7; poses are ours)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from sigmasplat.config import Config, FinalConfig, MappingConfig
from sigmasplat.errors import SigmaSplatError
from sigmasplat.fit.adam import Rates, VectorAdam
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.model.field import COLUMNS, GaussianField
from sigmasplat.model.submap import SubmapStore
from sigmasplat.render.view import View
from sigmasplat.types import Matrix, Progress

CACHE_BYTES = 64 << 20
"""Memory for prepared pictures; other pictures are read again when they are drawn."""


@dataclass(eq=False)
class Refined:
    """A refinement between two steps: the steps done, the map, the keyframes' poses T_world_camera [4, 4] with their
    Adam states, and the state of the random numbers."""

    done: int
    field: GaussianField
    poses: list[Matrix]
    motions: list[VectorAdam]
    numbers: dict[str, Any]


class SavedRefinement(Protocol):
    """Keeps the refinement of a final map between its steps, so that a stopped run does not repeat them."""

    def save(self, state: Refined) -> None:
        """Save a refinement if a save is due."""

    def load(self) -> Refined | None:
        """Return the saved refinement; None if nothing is saved."""


class KeyframeReader:
    """All keyframes of all submaps with their poses in the world; pictures are read from the store on demand.

    anchors: T_world_submap [4, 4] of each submap; `places`: submap and number of each keyframe; `poses`: their
    T_world_camera [4, 4], which `refine` may move; `motions`: Adam's state of each pose. Raises SigmaSplatError if
    there is no keyframe, or a submap's camera is not the view's.
    """

    def __init__(self, store: SubmapStore, anchors: Sequence[Matrix], view: View) -> None:
        self.store, self.camera = store, view.camera
        self.size = (view.alpha.shape[0], view.alpha.shape[1])
        self.places: list[tuple[int, int]] = []
        self.poses: list[Matrix] = []
        for index in range(len(store)):
            self._add(index, anchors[index])
        if not self.places:
            raise SigmaSplatError("the submaps have no keyframes, so the final map cannot be refined")
        self.motions = [VectorAdam.of(6) for _ in self.poses]
        self._target = lru_cache(max(1, CACHE_BYTES // (16 * view.alpha.numel())))(self._read)

    def _add(self, index: int, T_world_submap: Matrix) -> None:
        submap = self.store.load(index)
        if submap.camera != self.camera:
            raise SigmaSplatError(f"the camera of submap {index} is {submap.camera}, but the view has {self.camera}")
        self.places += [(index, k) for k in range(len(submap.frames))]
        self.poses += [T_world_submap @ T for T in submap.T_submap_camera]

    def __len__(self) -> int:
        return len(self.places)

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, i: int) -> Keyframe:
        """Return a keyframe. Its pose can move, except that of the first keyframe, which fixes the gauge."""
        return Keyframe(i, self._target(i), self.poses[i], fixed=i == 0, motion=self.motions[i])

    def poses_by_submap(self) -> list[list[Matrix]]:
        """Return the poses T_world_camera [4, 4] of each submap's keyframes."""
        found: list[list[Matrix]] = [[] for _ in range(len(self.store))]
        for (submap, _), T in zip(self.places, self.poses, strict=True):
            found[submap].append(T)
        return found

    def _read(self, i: int) -> Target:
        return Target.of_picture(self.store.picture(*self.places[i]), self.camera, self.size)


def refine(
    field: GaussianField,
    keyframes: KeyframeReader,
    config: Config,
    view: View,
    random: np.random.Generator,
    progress: Progress,
    done: int = 0,
    saved: SavedRefinement | None = None,
) -> list[float]:
    """Fit the field to keyframes drawn uniformly, and their poses with it; return the loss of each step.

    Poses move at the rates `final.lr_pose_translation` and `final.lr_pose_rotation`; `keyframes.poses` has the moved
    ones. Splats are pruned regularly. Every `sh_every` steps, colours gain one degree of view dependence. `done`: the
    number of steps that the field has already had. `saved` is offered the state after each pruning and each new degree.
    """
    final, mapping, losses = config.final, refinement(config), list[float]()
    while done < final.iterations:
        until_event = min(every - done % every for every in (final.prune_every, final.sh_every))
        steps = range(done, min(done + until_event, final.iterations))
        degree = min(final.sh_degree, done // final.sh_every)
        rates = decaying(mapping, final, done) if final.lr_means_last else None
        drawn = _draw(keyframes, steps, final.iterations, random, progress)
        losses += fit_field(field, view, drawn, mapping, schedule=rates, degree=degree).losses
        done = steps.stop
        if done % final.prune_every == 0:
            field.keep(field.opacities > final.prune_opacity)
        if saved is not None:
            saved.save(Refined(done, field, keyframes.poses, keyframes.motions, dict(random.bit_generator.state)))
    progress(final.iterations, final.iterations)
    return losses


def decaying(mapping: MappingConfig, final: FinalConfig, done: int) -> Iterator[Rates]:
    """Yield the rates of the refinement steps after `done`. That of the means decays exponentially from
    `mapping.lr_means` to `final.lr_means_last`."""
    for step in range(done, final.iterations):
        rates, share = Rates.of(mapping), step / max(final.iterations - 1, 1)
        rates.per_column[COLUMNS["means"]] = mapping.lr_means ** (1.0 - share) * final.lr_means_last**share
        yield rates


def refinement(config: Config) -> MappingConfig:
    """Return the mapping settings for refinement: the rates of its poses, and no likelihood if `final.uncertainty` is
    off."""
    final = config.final
    ours = replace(
        config.mapping, lr_pose_translation=final.lr_pose_translation, lr_pose_rotation=final.lr_pose_rotation
    )
    return ours if final.uncertainty else replace(ours, weight_nll_color=0.0, weight_nll_depth=0.0)


def _draw(
    keyframes: KeyframeReader, steps: range, total: int, random: np.random.Generator, progress: Progress
) -> Iterator[Sequence[Keyframe]]:
    """Draw one keyframe per step, uniformly; call `progress` before each, and keep its moved pose after it."""
    for step in steps:
        progress(step, total)
        i = int(random.integers(len(keyframes)))
        keyframe = keyframes[i]
        yield [keyframe]
        keyframes.poses[i] = keyframe.T_world_camera
