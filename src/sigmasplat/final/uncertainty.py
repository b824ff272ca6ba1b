"""Measure how sure a map is: variances of its splats, and weights calibrated on probe views."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.submap import SubmapStore
from sigmasplat.data.trajectory import evenly_spread
from sigmasplat.final.refinement import KeyframeReader
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.render.view import View
from sigmasplat.types import Matrix, Progress, no_progress
from sigmasplat.uncertainty.calibration import background_of, fit_weights, splat_residuals, splat_std, squared_errors
from sigmasplat.uncertainty.map_uncertainty import (
    COLOR_PARTS,
    DEPTH_PARTS,
    SHIPPED,
    Background,
    Calibration,
    MapUncertainty,
)
from sigmasplat.uncertainty.predictive import COVERED, variance_parts

PIXELS = 4000
"""About this many pixels of a probe view, every k-th one, calibrate the weights."""
STD_KEYFRAMES = 24
"""At most this many keyframes, evenly spread, decide the standard deviations of the splats."""
PROBES_MOST = 32
"""At most this many probe views, evenly spread, calibrate the weights."""
LIMIT = 4.0
"""Limit of errors in the fit (`fit_weights`). Depth errors at silhouettes are as large as the depth step there, and
colour errors of moved objects as large as their contrast, so a few pixels would decide."""

FIRM = ("extrapolated",)
"""Weights that stay near `pulled_to`: probe views are on the path, so they say little about views away from it."""


def probe_views(
    store: SubmapStore, anchors: Sequence[Matrix], view: View, most: int | None = None
) -> Iterator[Keyframe]:
    """Yield probe views of all submaps, evenly spread, with poses in the world, for planes of a view; anchors:
    T_world_submap [4, 4] of each submap; most: None = all. Their images are read one by one."""
    found, size = list[tuple[int, int, int, Matrix]](), (view.alpha.shape[0], view.alpha.shape[1])
    for s in range(len(store)):
        submap = store.load(s)
        found += [(s, k, frame, anchors[s] @ submap.T_submap_probe[k]) for k, frame in enumerate(submap.probe_frames)]
    for s, k, frame, T_world_probe in evenly_spread(found, len(found) if most is None else most):
        target = Target.of_picture(store.probe(s, k), view.camera, size)
        yield Keyframe(frame, target, T_world_probe, fixed=True)


def final_uncertainty(
    field: GaussianField, store: SubmapStore, anchors: Sequence[Matrix], config: Config, view: View,
    progress: Progress = no_progress,
) -> MapUncertainty | None:  # fmt: skip
    """Return how sure a map in the world is and the standard deviations of its splats, from its submaps' keyframes and
    probe views; None if `uncertainty.probes` is 0 or there is no splat. Calls `progress(keyframes read, total)`."""
    if not config.uncertainty.probes or not len(field):
        return None
    known = map_uncertainty(field, store, anchors, config, view, progress=progress)
    keyframes = KeyframeReader(store, anchors, view)
    chosen = (keyframes[row] for row in evenly_spread(range(len(keyframes)), STD_KEYFRAMES))
    return replace(known, std=splat_std(field, known, chosen, config.render, config.backend))


def map_uncertainty(
    field: GaussianField, store: SubmapStore, anchors: Sequence[Matrix], config: Config, view: View,
    pulled_to: Calibration = SHIPPED, progress: Progress = no_progress,
) -> MapUncertainty:  # fmt: skip
    """Return how sure a map is that was fitted to the keyframes of submaps at `anchors` (T_map_submap [4, 4] each).

    The weights are fitted to the submaps' probe views and pulled to `pulled_to`; without probe views they equal it.
    Calls `progress(keyframes read, total)`.
    """
    keyframes = KeyframeReader(store, anchors, view)
    background = background_of(keyframes)
    splats = splat_residuals(field, _counted(keyframes, progress), config.render, config.backend)
    probes = probe_views(store, anchors, view, PROBES_MOST)
    color, depth = probe_samples(field, splats, background, probes, config)
    calibration = Calibration(color.fitted(pulled_to.color), depth.fitted(pulled_to.depth), pulled_to.temperature)
    return MapUncertainty(splats, background, calibration, color.views)


def _counted(keyframes: KeyframeReader, progress: Progress) -> Iterator[Keyframe]:
    """Yield the keyframes; call `progress` before each."""
    for done, keyframe in enumerate(keyframes):
        progress(done, len(keyframes))
        yield keyframe


def probe_samples(
    field: GaussianField, splats: Tensor, background: Background, probes: Iterable[Keyframe], config: Config
) -> "tuple[Samples, Samples]":
    """Return the samples of colour and of depth of a map at probe views, with poses in the map's frame."""
    color, depth = Samples(COLOR_PARTS), Samples(DEPTH_PARTS)
    for probe in probes:
        target, T_camera_map = probe.target, se3.inverse(probe.T_world_camera)
        parts = variance_parts(field, splats, background, target.camera, T_camera_map, config.render, config.backend)
        image, depth_m = target.image.to(parts.alpha), target.depth_image.to(parts.alpha)
        raw_depth = parts.depth_m * parts.alpha.clamp(min=COVERED)
        errors, known = squared_errors(parts.image, raw_depth, parts.alpha, image, depth_m)
        channels = (parts.image.clamp(0.0, 1.0) - image).square()
        color.add(parts.color, channels, torch.ones_like(known[..., 0], dtype=torch.bool))
        depth.add(parts.depth, errors[..., 1:], known[..., 1] > 0)
    return color, depth


@dataclass(eq=False)
class Samples:
    """Pixels of probe views: parts of the variance by name, and squared errors of each channel."""

    names: Sequence[str]

    def __post_init__(self) -> None:
        self.parts, self.errors, self.views = list[Tensor](), list[Tensor](), 0

    def add(self, parts: Tensor, errors: Tensor, known: Tensor) -> None:
        """Add every k-th known pixel of a view: parts [K, H, W], errors [H, W, C] and known [H, W]."""
        step = max(1, known.numel() // PIXELS)
        rows = torch.arange(0, known.numel(), step, device=errors.device)
        rows = rows[known.reshape(-1)[rows]]
        self.parts.append(parts.reshape(len(self.names), -1)[:, rows].cpu())
        self.errors.append(errors.reshape(known.numel(), -1)[rows].cpu())
        self.views += 1

    def fitted(self, pulled_to: Mapping[str, float]) -> dict[str, float]:
        """Return the best weights by name."""
        if not self.errors:
            return dict(pulled_to)
        planes, errors = self.joined()
        return fit_weights(
            dict(zip(self.names, planes, strict=True)), errors.mean(1), pulled_to, self.views, LIMIT, FIRM
        )

    def joined(self) -> tuple[Matrix, Matrix]:
        """Return the parts [K, P] and the squared errors [P, C] of all pixels."""
        if not self.errors:
            return np.zeros((len(self.names), 0)), np.zeros((0, 1))
        return torch.cat(self.parts, 1).double().numpy(), torch.cat(self.errors).double().numpy()
