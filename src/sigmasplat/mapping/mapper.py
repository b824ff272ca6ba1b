"""Mapping at a keyframe: seed new splats, fit the field in two halves; densify, fade and prune splats in between
(VarSplat §2; CG-SLAM §4, 5, 7)."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field as dataclass_field
from itertools import repeat

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.submap import Picture, Submap
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.field import DensifyStats, FieldFit, fitting
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.fit.tracking_loss import PoseMaps
from sigmasplat.mapping import densify
from sigmasplat.mapping.moving import carve, mask_keyframes
from sigmasplat.mapping.seeding import first_pixels, later_pixels, make_splats, thin_out
from sigmasplat.mapping.window import choose_window, dominating, draw_keyframes
from sigmasplat.render.view import View
from sigmasplat.types import ShouldStop, Task, never

RECENT = 10
"""Splats are carved away by the newest keyframes, at most this many."""
LEAST_SHARE = 1 / 3
"""Share of a keyframe's iterations that are made even if another keyframe waits."""


@dataclass
class SecondHalf:
    """The second half of a keyframe's steps, as far as it is still to be made.

    frozen_below: splats with ids below it keep their colours; faded: ids of the splats that are judged after it.
    """

    steps: int
    frozen_below: int
    faded: Tensor


@dataclass(eq=False)
class Mapper:
    """Owns the field and the keyframes of the active submap. Poses are in the submap's frame.

    first_pending: the steps of the first keyframe that are still to be made (`mapping.divided`).
    half: what is still to be made of the newest keyframe's second half (`mapping.divided`).
    """

    config: Config
    random: np.random.Generator
    field: GaussianField = dataclass_field(default_factory=GaussianField.empty)
    keyframes: list[Keyframe] = dataclass_field(default_factory=list)
    first_pending: int = 0
    half: SecondHalf | None = None

    @property
    def pending(self) -> int:
        """Return how many steps are still to be made."""
        return self.first_pending + (self.half.steps if self.half else 0)

    @property
    def pending_now(self) -> int:
        """Return how many of these steps the next frame makes, if it is not mapped."""
        c = self.config.mapping
        return min(self.pending, c.first_per_frame if self.first_pending else c.half_per_frame)

    def mapping(self, view: View, newest: Keyframe, should_stop: ShouldStop = never) -> Task[FieldFit]:
        """Map one keyframe: seed, choose the window of keyframes, fit, densify and prune, fit again, prune again, in
        slices of one iteration. With `mapping.in_halves` the second half of the iterations is left to `refining`, and
        what `refining` has not made is made before the next keyframe. The first keyframe of a submap that inherits
        splats is already mapped; it is only added to the list.

        should_stop: asked before each iteration; if it returns True, the rest of a part's iterations is left out after
        `LEAST_SHARE` of them.
        """
        self.field = self.field.to(view.sums.device)  # the active field stays on the view's device
        c, begun = self.config.mapping, len(self.field) > 0
        if begun and not self.keyframes:
            self._append(newest)
            self._note_visible(view)
            return FieldFit()
        yield from self._left_of_half(view, should_stop)
        first_new = self.field.next_id
        self._append(newest)
        self._leave_out_moving()
        self._seed(view, newest.target, newest.T_world_camera)
        yield
        if c.colors == "code":
            self.field.forget()
        steps = c.iterations if begun else c.first_iterations
        rates = iter([Rates.of(c)] * steps if begun else Rates.falling(c, steps))
        if c.divided and not begun:
            steps = min(c.iterations, steps)
            self.first_pending = c.first_iterations - steps
        window = self._window(view)
        stats = DensifyStats.of(self.keyframes[-1], len(self.field), self.field.params.device)
        self._choose_movable(c.poses_from == "start")
        frozen_below = self._frozen_below(first_new, "half")
        fit = yield from self._fit(view, window, steps // 2, rates, frozen_below, stats, should_stop)
        self._densify(view, stats)
        self._prune()
        yield
        self.half = SecondHalf(
            steps - steps // 2, self._frozen_below(first_new, "end"), self._fade_uncertain(view, window)
        )
        yield
        if not c.in_halves:
            self._choose_movable(True)
            fit.join((yield from self._second_half(view, window, self.half, rates, should_stop)))
        return fit

    def _second_half(
        self, view: View, window: list[Keyframe], half: SecondHalf, rates: Iterator[Rates], should_stop: ShouldStop,
        at_most: int | None = None,
    ) -> Task[FieldFit]:  # fmt: skip
        """Make the steps of the second half that are left, or some of them; after the last one, prune."""
        steps, share = (half.steps, LEAST_SHARE) if at_most is None else (min(at_most, half.steps), 0.0)
        fit = yield from self._fit(view, window, steps, rates, half.frozen_below, None, should_stop, share)
        half.steps -= len(fit.losses)
        if at_most is None or not half.steps:
            self._prune(self._still_uncertain(view, window, half.faded))
            self.half = None
        return fit

    def _left_of_half(self, view: View, should_stop: ShouldStop, at_most: int | None = None) -> Task[FieldFit]:
        """Make steps that are left of the second half, if there is one. A submap that has inherited one, but no splats,
        has no keyframe yet."""
        if self.half is None or not self.keyframes:
            return FieldFit()
        rates = repeat(Rates.of(self.config.mapping))
        return (yield from self._second_half(view, self._window(view), self.half, rates, should_stop, at_most))

    def add(self, view: View, keyframe: Keyframe) -> None:
        """Add a keyframe and seed splats at it, without fitting them. The submap must have a keyframe."""
        self._append(keyframe)
        self._leave_out_moving()
        self._note_visible(view)
        self._seed(view, keyframe.target, keyframe.T_world_camera)

    def seeding_again(self, view: View) -> Task[None]:
        """Forget the splats and seed new ones at each keyframe, in slices of one; their steps are pending."""
        c = self.config.mapping
        self.field.keep(torch.zeros(len(self.field), dtype=torch.bool, device=self.field.params.device))
        self.half, self.first_pending = None, c.first_iterations + c.iterations * (len(self.keyframes) - 1)
        for keyframe in self.keyframes:
            self._seed(view, keyframe.target, keyframe.T_world_camera)
            yield

    def refining(self, view: View, steps: int, should_stop: ShouldStop) -> Task[None]:
        """Fit the map to its keyframes for more steps, in slices of one, until `should_stop` returns True; the
        keyframes keep their poses. Pending steps count as made."""
        steps -= len((yield from self._left_of_half(view, should_stop, steps)).losses)
        if not steps:
            return
        self._choose_movable(False)
        rates = repeat(Rates.of(self.config.mapping))
        for _ in self._fit(view, self._window(view), steps, rates, 0, None, should_stop, least_share=0.0):
            self.first_pending = max(self.first_pending - 1, 0)
            yield

    def _append(self, keyframe: Keyframe) -> None:
        """Add a keyframe to the list; the first one of a submap is fixed."""
        keyframe.fixed = not self.keyframes
        self.keyframes.append(keyframe)

    def _leave_out_moving(self) -> None:
        """Mask what moves in the newest keyframe and has gone from earlier ones, and remove splats from free space."""
        c, scale = self.config.moving, self.config.render.scene_scale
        if c.find:
            mask_keyframes(self.keyframes, c, scale)
            carve(self.field, self.keyframes[-RECENT:], c.carve_votes, scale)

    def _window(self, view: View) -> list[Keyframe]:
        """Return the keyframes to fit, the newest first; all of them if `mapping.window` is 0."""
        c = self.config.mapping
        if not c.window:
            return self.keyframes[::-1]
        self._note_visible(view)
        return choose_window(self.keyframes, c.window, c.covisibility)

    def _note_visible(self, view: View) -> None:
        """Record which splats the newest keyframe sees, if windows are chosen by them."""
        if self.config.mapping.window and self.config.mapping.covisibility == "splats":
            newest = self.keyframes[-1]
            view.forward(self.field.params, se3.inverse(newest.T_world_camera), layers=True)
            newest.visible_ids = dominating(view, self.field)

    def _fit(
        self, view: View, window: list[Keyframe], steps: int, rates: Iterator[Rates], frozen_below: int,
        stats: DensifyStats | None, should_stop: ShouldStop, least_share: float = LEAST_SHARE,
    ) -> Task[FieldFit]:  # fmt: skip
        """Fit the field to the window, in slices; splats with ids below `frozen_below` keep their colours."""
        c = self.config.mapping
        drawn = draw_keyframes(window[::-1], steps, c.newest_probability, self.random)
        batches = drawn if c.frames_per_step else repeat(window[::-1], steps)
        frozen = int((self.field.ids < frozen_below).sum())
        wanted = stats if self.config.primitives.split_gradient > 0 else None
        shortened = _shortened(batches, round(steps * least_share), should_stop)
        return (yield from fitting(self.field, view, shortened, c, rates, frozen, stats=wanted))

    def _frozen_below(self, first_new: int, until: str) -> int:
        """Return the id below which splats keep their colours until half or the end of a keyframe's steps; `first_new`
        is the id of the first new splat."""
        colors = self.config.mapping.colors
        if colors == "code":
            return self.field.next_id if until == "half" else 0
        return first_new if colors == "old-frozen" else 0

    def _choose_movable(self, poses: bool) -> None:
        """Mark the keyframes whose poses the next fit may move: all, the newest, or none."""
        for keyframe in self.keyframes:
            keyframe.movable = poses and (self.config.mapping.poses == "all" or keyframe is self.keyframes[-1])

    def finished(self, index: int) -> tuple[Submap, list[Picture]]:
        """Return the finished submap in host memory, and the pictures of its keyframes."""
        poses = np.stack([keyframe.T_world_camera for keyframe in self.keyframes])
        frames = tuple(keyframe.index for keyframe in self.keyframes)
        pictures = [keyframe.picture() for keyframe in self.keyframes]
        field = GaussianField.side_by_side([self.field])
        return Submap(index, field, frames, poses, self.keyframes[0].target.camera), pictures

    def successor(self, view: View, T_submap_camera: NDArray[np.float64]) -> "Mapper":
        """Return the mapper of the next submap, whose frame is the camera at T_submap_camera: empty, or with copies of
        the splats that this camera sees (`submaps.inherit`)."""
        field = GaussianField.empty()
        if self.config.submaps.inherit:
            T_new_old = se3.inverse(T_submap_camera)
            view.forward(self.field.params, T_new_old)
            seen = view.visible(len(self.field)).to(self.field.params.device)
            field = self.field.part(seen).moved(torch.from_numpy(T_new_old))
        return Mapper(self.config, self.random, field)

    def _seed(self, view: View, target: Target, T_world_camera: NDArray[np.float64]) -> None:
        """Add splats where the map does not explain the keyframe, up to the maximum number of splats."""
        c = self.config.seeding
        if len(self.field) == 0:
            wanted = target.depth_image.numpy() > 0
            pixels = first_pixels(target, c, self.random)
        else:
            view.forward(self.field.params, se3.inverse(T_world_camera))
            wanted = later_pixels(PoseMaps.of(view), target, c)
            pixels = thin_out(wanted, c, self.random)
        spacing_px = float(np.sqrt(wanted.sum() / max(pixels.sum(), 1)))
        new = make_splats(target, T_world_camera, pixels, spacing_px, self.field, c)
        room = c.max_splats - len(self.field) if c.max_splats else len(new)
        if len(new) > room:
            new.keep(torch.from_numpy(self.random.permutation(len(new))[: max(room, 0)].copy()).sort().values)
        self.field.append(new)

    def _densify(self, view: View, stats: DensifyStats) -> None:
        """Split and clone the splats with the largest gradient in the newest keyframe, and split those that are too
        large in it, up to the maximum number of splats."""
        p, most = self.config.primitives, self.config.seeding.max_splats
        room = max(most - len(self.field), 0) if most else len(self.field)
        densify.multiply(self.field, densify.densify_mask(stats, p.split_gradient, room), p, self.random)
        if p.split_radius_px:
            T_camera_world = se3.inverse(self.keyframes[-1].T_world_camera)
            coarse = densify.too_wide(self.field, T_camera_world, view.camera, p.split_radius_px)
            coarse[coarse.nonzero()[max(most - len(self.field), 0) if most else len(coarse) :]] = False
            densify.split(self.field, coarse, self.random)

    def _fade_uncertain(self, view: View, window: list[Keyframe]) -> Tensor:
        """Fade the splats that contradict the depth readings of the window; return their ids."""
        p = self.config.primitives
        if not p.uncertain_m2:
            return self.field.ids[:0]
        return densify.fade(self.field, self._uncertainty_m2(view, window) > p.uncertain_m2, p.faded_opacity)

    def _still_uncertain(self, view: View, window: list[Keyframe], faded: Tensor) -> Tensor:
        """Return which faded splats did not recover, bool [N]."""
        p = self.config.primitives
        if not len(faded):
            return torch.zeros_like(self.field.ids, dtype=torch.bool)
        nu_m2 = self._uncertainty_m2(view, window)
        return densify.still_uncertain(self.field, faded, nu_m2, p.uncertain_m2, p.least_opacity)

    def _uncertainty_m2(self, view: View, window: list[Keyframe]) -> Tensor:
        """Return how far each splat [N] is from the depth readings of the window, or of the newest keyframe if there is
        no window, m²."""
        keyframes = window if self.config.mapping.window else window[:1]
        return densify.splat_uncertainty(self.field, view, keyframes)[0]

    def _prune(self, also: Tensor | None = None) -> None:
        """Remove splats that are too faint or too large, and those marked in `also` [N]."""
        gone = self.field.opacities <= self.config.mapping.prune_opacity
        gone |= densify.too_large(self.field, self.config.primitives.most_scale_m)
        self.field.keep(~(gone if also is None else gone | also))


def _shortened(batches: Iterable[list[Keyframe]], least: int, should_stop: ShouldStop) -> Iterator[list[Keyframe]]:
    """Yield batches, but none after the first `least` ones as soon as `should_stop` returns True."""
    for done, batch in enumerate(batches):
        if done >= least and should_stop():
            return
        yield batch
