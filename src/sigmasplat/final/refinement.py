"""Refine a map over all keyframes: splats and keyframe poses together (VarSplat §7; poses are ours)."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field as dataclass_field, replace
from functools import lru_cache
from math import log

import numpy as np
import torch

from sigmasplat.config import Config, FinalConfig, MappingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import NEUTRAL, centred
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.data.submap import SubmapStore
from sigmasplat.fit.adam import BETA2, Rates, VectorAdam
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.pose import fit_exposure
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.mapping.densify import prune_by_weight
from sigmasplat.render.view import View
from sigmasplat.types import Matrix, Progress


def limit_shapes(field: GaussianField, axis_ratio: float, needle_ratio: float) -> None:
    """Limit the ratios of the axes of every splat; 0 turns a limit off.

    The longest axis becomes at most `needle_ratio` times the second longest, and the two shorter axes at least
    1/`axis_ratio` of the longest. Adam's moments of changed axes are cleared.
    """
    columns = COLUMNS["log_scales"]
    before = field.params[:, columns]
    limited = before
    if needle_ratio:
        second = before.median(1, keepdim=True).values
        limited = torch.minimum(limited, second + log(needle_ratio))
    if axis_ratio:
        longest = limited.amax(1, keepdim=True)
        limited = torch.maximum(limited, longest - log(axis_ratio))
    changed = limited != before
    for moment in (field.moment1, field.moment2):
        moment[:, columns] = moment[:, columns].masked_fill(changed, 0.0)
    field.params[:, columns] = limited


EXPOSURE_FROM = 0.1
"""Exposures are fitted from this share of the refinement on: the merged map has the colours of single submaps."""
CACHE_BYTES = 128 << 20
"""Memory for prepared pictures; other pictures are read again when they are drawn."""


class KeyframeReader:
    """All keyframes of all submaps with their poses in the world; pictures are read from the store on demand.

    anchors: T_world_submap [4, 4] of each submap; `places`: submap and number of each keyframe; `poses`: their
    T_world_camera [4, 4], which `refine` may move; `motions`: Adam's state of each pose; `exposures` [K, 3, 2]: those
    of the images relative to the map, as fitted last; `left`: the keyframes left in the current epoch.
    """

    def __init__(self, store: SubmapStore, anchors: Sequence[Matrix], view: View) -> None:
        self.store, self.camera = store, view.camera
        self.size = (view.alpha.shape[0], view.alpha.shape[1])
        self.places: list[tuple[int, int]] = []
        self.poses: list[Matrix] = []
        for index in range(len(store)):
            submap = store.load(index)
            self.places += [(index, k) for k in range(len(submap.frames))]
            self.poses += [anchors[index] @ T for T in submap.T_submap_camera]
        self.tracked = tuple(self.poses)
        self.motions, self.left = [VectorAdam.of(6) for _ in self.poses], list[int]()
        self.exposures = np.tile(NEUTRAL, (len(self.poses), 1, 1))
        self._target = lru_cache(max(1, CACHE_BYTES // (16 * view.alpha.numel())))(
            lambda i: Target.of_picture(self.store.picture(*self.places[i]), self.camera, self.size)
        )

    def __len__(self) -> int:
        return len(self.places)

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, i: int) -> Keyframe:
        """Return a keyframe as recorded. Its pose can move, unless it is the first one, which fixes the gauge."""
        return Keyframe(i, self._target(i), self.poses[i], fixed=i == 0, motion=self.motions[i])

    def in_map_exposure(self, i: int) -> Keyframe:
        """Return a keyframe with its colours in the exposure of the map."""
        keyframe = self[i]
        if (self.exposures != NEUTRAL).any():
            keyframe.target = keyframe.target.without_exposure(centred(self.exposures)[i])
        return keyframe

    def draw(self, order: str, random: np.random.Generator) -> int:
        """Return the number of the next keyframe: uniformly drawn, or the next one of an epoch (`final.schedule`)."""
        if order == "random":
            return int(random.integers(len(self)))
        self.left = self.left or random.permutation(len(self)).tolist()
        return self.left.pop()

    def keep_pose(self, moved: Keyframe, share: float) -> None:
        """Keep the pose of a keyframe that a step has moved, pulled back to the tracked one by a share of the motion
        between them, 0 to 1: weight decay apart from Adam's step (Loshchilov & Hutter 2019), with the tracked pose as
        its centre."""
        T, tracked = moved.T_world_camera, self.tracked[moved.index]
        if share and not moved.fixed:
            T = se3.orthonormalise(T @ se3.exp(share * se3.log(se3.inverse(T) @ tracked)))
        self.poses[moved.index] = T

    def poses_in(self, anchors: Sequence[Matrix]) -> list[list[Matrix]]:
        """Return T_submap_camera [4, 4] of the keyframes of each submap; anchors: T_world_submap [4, 4] of each."""
        found: list[list[Matrix]] = [[] for _ in range(len(self.store))]
        for (submap, _), T in zip(self.places, self.poses, strict=True):
            found[submap].append(se3.inverse(anchors[submap]) @ T)
        return found

    def exposures_in_submaps(self) -> list[Matrix]:
        """Return the exposures [K, 3, 2] of the keyframes of each submap, relative to the mean of all."""
        found, submap_of = centred(self.exposures), np.array([submap for submap, _ in self.places])
        return [found[submap_of == index] for index in range(len(self.store))]


def refine(
    field: GaussianField, keyframes: KeyframeReader, config: Config, view: View, random: np.random.Generator,
    progress: Progress, clock: "Clock | None" = None,
) -> list[float]:  # fmt: skip
    """Fit the field to all keyframes, one per step, and their poses with it; return the loss of each step.

    Poses move at the rates `final.lr_pose_translation` and `final.lr_pose_rotation`, about `final.pose_reach_m` at
    most; `keyframes.poses` has the moved ones. Splats are pruned before, regularly, and at the end. Their shapes are
    limited (`limit_shapes`). Every `sh_every` steps, colours gain one degree of view dependence. `clock`: None = from
    now on, with the budget `final.seconds`.
    """
    final, mapping, losses, done = config.final, refinement(config), list[float](), 0
    clock = clock or Clock(final.seconds)
    own = final.lr_means_last or final.lr_log_scales
    changes_rates = own or (final.lr_factor, final.lr_decay, final.beta2) != (1.0, 1.0, BETA2)
    prune_by_weight(field, view, keyframes, final.prune_weight_px)
    while done < final.iterations and not clock.is_over:
        until_event = min(every - done % every for every in (final.prune_every, final.sh_every))
        steps = range(done, min(done + until_event, final.iterations))
        degree = min(final.sh_degree, done // final.sh_every)
        rates = decaying(mapping, final, done, clock, config.render.scene_scale) if changes_rates else None
        drawn = _draw(keyframes, steps, config, random, progress, clock, view)
        losses += (fitted := fit_field(field, view, drawn, mapping, schedule=rates, degree=degree).losses)
        done += len(fitted)
        limit_shapes(field, final.max_axis_ratio, final.max_needle_ratio)
        if done % final.prune_every == 0:
            field.keep(field.opacities > final.prune_opacity)
    prune_by_weight(field, view, keyframes, final.prune_weight_px)
    progress(final.iterations, final.iterations)
    return losses


@dataclass(frozen=True)
class Clock:
    """Measures a stage of a refinement against its time budget.

    ends_s: the stage ends after this many seconds of the whole refinement; 0 = without a budget. begins_s: seconds of
    the refinement before this stage.
    """

    ends_s: float
    begins_s: float = 0.0
    started_s: float = dataclass_field(default_factory=lambda: time.perf_counter())

    @property
    def spent_s(self) -> float:
        """Return the seconds of the refinement so far."""
        return time.perf_counter() - self.started_s

    @property
    def share(self) -> float:
        """Return the share of the stage's time that is spent; 0 without a budget."""
        if not self.ends_s:
            return 0.0
        return (self.spent_s - self.begins_s) / max(self.ends_s - self.begins_s, 1e-9)

    def done(self, step: int, steps: float) -> float:
        """Return the share of the stage that is done before one of its steps, of its steps or of its time, 0 to 1."""
        return min(1.0, max(step / max(steps, 1), self.share))

    @property
    def is_over(self) -> bool:
        """Return whether the stage's time is spent."""
        return self.share >= 1.0

    def next_stage(self, ends_s: float) -> "Clock":
        """Return the clock of the next stage, which begins now."""
        return replace(self, begins_s=min(self.spent_s, self.ends_s), ends_s=ends_s)


def decaying(
    mapping: MappingConfig, final: FinalConfig, done: int, clock: Clock, scene_scale: float = 1.0
) -> Iterator[Rates]:
    """Yield the rates of the refinement steps after `done`.

    All rates start at `final.lr_factor` times those of mapping, that of the means at the one of mapping, that of the
    sizes at `final.lr_log_scales` if this is set. They decay exponentially to the share `final.lr_decay` of the first;
    that of the means decays from `mapping.lr_means` to `final.lr_means_last` if this is set.
    """
    for step in range(done, final.iterations + 1):
        rates, share = replace(Rates.of(mapping), beta2=final.beta2), clock.done(step, final.iterations - 1)
        rates.per_column.mul_(final.lr_factor)
        rates.per_column[COLUMNS["means"]] /= final.lr_factor
        if final.lr_log_scales:
            rates.per_column[COLUMNS["log_scales"]] = final.lr_log_scales
        rates.per_column.mul_(final.lr_decay**share)
        if final.lr_means_last:
            last = final.lr_means_last * scene_scale
            rates.per_column[COLUMNS["means"]] = mapping.lr_means ** (1.0 - share) * last**share
        yield rates


def pull(final: FinalConfig, pose_rate: float) -> float:
    """Return the share by which a step pulls a pose back to the tracked one. A step of Adam moves a pose by at most
    about its rate, so a pose whose gradient never changes its direction comes to rest at `final.pose_reach_m`;
    pose_rate: factor on the rates."""
    return min(pose_rate * final.lr_pose_translation / final.pose_reach_m, 1.0) if final.pose_reach_m else 0.0


def refinement(config: Config) -> MappingConfig:
    """Return the mapping settings for refinement: the rates of its poses, no U if `final.weight_moment` is off, and no
    likelihood if `final.uncertainty` is off."""
    final = config.final
    ours = replace(
        config.mapping, lr_pose_translation=final.lr_pose_translation, lr_pose_rotation=final.lr_pose_rotation,
        weight_moment=config.mapping.weight_moment if final.weight_moment else 0.0,
    )  # fmt: skip
    return ours if final.uncertainty else replace(ours, weight_nll_color=0.0, weight_nll_depth=0.0)


def _draw(
    keyframes: KeyframeReader, steps: range, config: Config, random: np.random.Generator, progress: Progress,
    clock: Clock, view: View,
) -> Iterator[Sequence[Keyframe]]:  # fmt: skip
    """Draw one keyframe per step; call `progress` before each. After each, keep its moved pose and, with
    `final.exposure`, fit its exposure to the view's rendering. End early if the time budget is spent."""
    for step in steps:
        if clock.is_over:
            return
        progress(max(step, int(clock.share * config.final.iterations)), config.final.iterations)
        i = keyframes.draw(config.final.order, random)
        keyframe, share = keyframes.in_map_exposure(i), clock.done(step, config.final.iterations - 1)
        keyframe.pose_rate = config.final.lr_decay**share
        yield [keyframe]
        keyframes.keep_pose(keyframe, pull(config.final, keyframe.pose_rate))
        if config.final.exposure and share >= EXPOSURE_FROM:
            keyframes.exposures[i] = fit_exposure(view, keyframes[i].target)
