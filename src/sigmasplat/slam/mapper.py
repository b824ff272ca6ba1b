"""Grow and adjust the map at keyframes: seed what is new, fit the field, prune what has faded (VarSplat §2)."""

from dataclasses import dataclass, field as dataclass_field

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.config import Config
from sigmasplat.fit.field import FieldFit, fit_field
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.fit.tracking_loss import PoseMaps
from sigmasplat.model import se3
from sigmasplat.model.field import GaussianField, Rows
from sigmasplat.model.submap import Picture, Submap
from sigmasplat.render.view import View
from sigmasplat.slam.rules import draw_keyframes
from sigmasplat.slam.seeding import first_pixels, later_pixels, make_splats, thin_out


@dataclass(eq=False)
class Mapper:
    """Owns the active submap's field and keyframes; nobody else writes them. Poses are in the submap's frame."""

    config: Config
    random: np.random.Generator
    field: GaussianField = dataclass_field(default_factory=GaussianField.empty)
    keyframes: list[Keyframe] = dataclass_field(default_factory=list)

    def map(self, view: View, index: int, target: Target, T_world_camera: NDArray[np.float64]) -> FieldFit:
        """Take in one keyframe: seed, then fit in two halves with a pruning after each."""
        first, empty = not self.keyframes, len(self.field) == 0
        old = len(self.field)
        self.keyframes.append(Keyframe(index, target, T_world_camera, fixed=first))
        self._seed(view, target, T_world_camera)
        c = self.config.mapping
        iterations = c.first_iterations if empty else c.iterations
        fit = FieldFit()
        for half in (iterations // 2, iterations - iterations // 2):
            order = draw_keyframes(self.keyframes, half, c.newest_probability, c.keyframe_history, self.random)
            done = fit_field(self.field, view, order, c, None, old if c.freeze_old_colors else 0)
            old -= self._prune(old)
            fit.losses += done.losses
            for stage, seconds in done.seconds.items():
                fit.seconds[stage] = fit.seconds.get(stage, 0.0) + seconds
        return fit

    def finished(self, index: int) -> tuple[Submap, list[Picture]]:
        """Return what has been mapped as a finished submap, and what its keyframes saw."""
        poses = np.stack([keyframe.T_world_camera for keyframe in self.keyframes])
        frames = tuple(keyframe.index for keyframe in self.keyframes)
        pictures = [keyframe.target.picture() for keyframe in self.keyframes]
        field = GaussianField(
            self.field.params.clone(), extras={n: Rows(e.params.clone()) for n, e in self.field.extras.items()}
        )
        return Submap(index, field, frames, poses, self.keyframes[0].target.camera), pictures

    def successor(self, view: View, T_submap_camera: NDArray[np.float64]) -> "Mapper":
        """Return the mapper of the next submap, whose frame is the camera at T_submap_camera: empty, or with copies of
        the splats in view from there (`submaps.inherit`)."""
        field = GaussianField.empty()
        if self.config.submaps.inherit:
            T_new_old = se3.inverse(T_submap_camera)
            view.forward(self.field.params, T_new_old)
            field = self.field.moved(torch.from_numpy(T_new_old))
            field.keep(view.visible(len(field)))
        return Mapper(self.config, self.random, field)

    def _seed(self, view: View, target: Target, T_world_camera: NDArray[np.float64]) -> None:
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

    def _prune(self, old: int) -> int:
        """Drop splats that have faded; return how many of the first `old` went."""
        keep = self.field.opacities > self.config.mapping.prune_opacity
        self.field.keep(keep)
        return int((~keep[:old]).sum())
