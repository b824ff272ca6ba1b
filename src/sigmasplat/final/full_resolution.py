"""The last stage of the final map, after refinement at working size: refine it on images of the camera's own size."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from sigmasplat.config import Config, FinalConfig, MappingConfig
from sigmasplat.data.camera import Camera, centred
from sigmasplat.data.field import GaussianField
from sigmasplat.final.refinement import Clock, KeyframeReader, refinement
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.render.backend import make_view
from sigmasplat.render.render import as_refined
from sigmasplat.render.view import View
from sigmasplat.types import Progress

CACHE_BYTES = 64 << 20
"""Memory for prepared images; other photos are decoded again when they are drawn."""
TURN_STEPS = 25
WORKING_TURNS = 2
"""After one turn of steps on photos come this many turns on working images, whose steps cost a third. With one turn,
livingroom gains 0.2 dB at full size and loses 0.2 dB at working size, and the stage takes a quarter longer."""
FIRST_RATE, LAST_RATE = 4.0, 0.4
"""Learning rates in the first and last step, relative to those of mapping. With 12 in the first step a quarter of the
splats of redkitchen fades. Steps on single images leave noise in the splats, so the rates fall."""
WORKING_SHARE = 1 / 3
"""The share of a time budget after which the stage at working size ends, if there are photos."""


class PhotoReader:
    """The keyframes of a reader that have photos, with images of the view's camera, which are decoded when drawn."""

    def __init__(self, keyframes: KeyframeReader, view: View) -> None:
        self.keyframes, self.camera = keyframes, view.camera
        self.size = (view.alpha.shape[0], view.alpha.shape[1])
        store, places = keyframes.store, keyframes.places
        self.rows = [row for row, place in enumerate(places) if store.picture(*place).photo is not None]
        self._target = lru_cache(max(1, CACHE_BYTES // (16 * view.alpha.numel())))(self._read)

    def __len__(self) -> int:
        return len(self.rows)

    def in_map_exposure(self, i: int) -> Keyframe:
        """Return the photo of a keyframe with its colours in the exposure of the map."""
        row = self.rows[i]
        target = self._target(row).without_exposure(centred(self.keyframes.exposures)[row])
        return Keyframe(row, target, self.keyframes.poses[row], fixed=True)

    def _read(self, row: int) -> Target:
        picture = self.keyframes.store.picture(*self.keyframes.places[row])
        assert picture.photo is not None
        return Target.of(picture.photo.frame(picture.depth_m, self.keyframes.camera, self.camera), self.size)


def working_seconds(keyframes: KeyframeReader, final: FinalConfig) -> float:
    """Return after how many seconds of the refinement the stage at working size ends; 0 = no time budget."""
    return final.seconds * (WORKING_SHARE if final.width and _photo_cameras(keyframes) else 1.0)


def _photo_cameras(keyframes: KeyframeReader) -> list[Camera]:
    """Return the cameras of the photos. A submap has photos of one camera."""
    found = [keyframes.store.picture(*place).photo for place in keyframes.places if place[1] == 0]
    return [photo.camera for photo in found if photo is not None]


def _like(view: View, camera: Camera, config: Config, refined_fx: float | None) -> View:
    """Return a view of a camera with the planes of `view`, for a map that is refined on images of a focal length."""
    return make_view(
        config.backend, camera, as_refined(config.render, camera, refined_fx), variance=len(view.sums) >= 7
    )


def refine_on_photos(
    field: GaussianField, keyframes: KeyframeReader, config: Config, view: View, random: np.random.Generator,
    progress: Progress, done: int, clock: Clock,
) -> tuple[int, float | None]:  # fmt: skip
    """Fit the field to photos of keyframes, if there are any, and to their working images, in turns, at fixed poses.

    view: that of the working images. `done`: the number of steps that the field has already had; those of this stage
    are counted from `final.iterations` on. Returns their number at the end, which is lower if the time of `clock` is
    spent, and the focal length of the photos, pixels (None: the field was not fitted to photos). Rates fall in time if
    it is short. Calls `progress(steps done, total)`.
    """
    final = config.final
    if not final.width or clock.is_over or not (cameras := _photo_cameras(keyframes)):
        return done, None
    large = _like(view, max(cameras, key=lambda camera: camera.width), config, None)
    view = _like(view, view.camera, config, large.camera.fx)
    photos, length = PhotoReader(keyframes, large), steps_of(clock, final)
    mapping = replace(refinement(config), lr_pose_translation=0.0, lr_pose_rotation=0.0)
    degree = min(final.sh_degree, final.iterations // final.sh_every)
    turns: list[tuple[View, PhotoReader | KeyframeReader]] = [(large, photos)] + [(view, keyframes)] * WORKING_TURNS
    done = max(done, final.iterations)
    while (since := done - final.iterations) < length and not clock.is_over:
        of_view, images = turns[since // TURN_STEPS % len(turns)]
        steps = range(done, int(min(done + TURN_STEPS - since % TURN_STEPS, final.iterations + length)))
        rates = (falling(mapping, clock.done(step - final.iterations, length)) for step in steps)
        fit_field(field, of_view, _draw(images, steps, final, random, progress, clock), mapping, rates, degree=degree)
        field.keep(field.opacities > final.prune_opacity)
        done = steps.stop
    progress(2 * final.iterations, 2 * final.iterations)
    return done, large.camera.fx


def steps_of(clock: Clock, final: FinalConfig) -> float:
    """Return the largest number of steps of this stage: without end if a time budget ends it."""
    return math.inf if clock.ends_s else final.iterations


def falling(mapping: MappingConfig, share: float) -> Rates:
    """Return the rates at a share of the stage, 0 to 1: they decay exponentially from `FIRST_RATE` to `LAST_RATE` times
    those of the settings."""
    rates = Rates.of(mapping)
    rates.per_column.mul_(FIRST_RATE ** (1.0 - share) * LAST_RATE**share)
    return rates


def _draw(
    images: PhotoReader | KeyframeReader, steps: range, final: FinalConfig, random: np.random.Generator,
    progress: Progress, clock: Clock,
) -> Iterator[Sequence[Keyframe]]:  # fmt: skip
    """Draw one keyframe per step, uniformly; call `progress` before each."""
    for step in steps:
        share = clock.done(step - final.iterations, steps_of(clock, final))
        progress(final.iterations + round(share * final.iterations), 2 * final.iterations)
        yield [images.in_map_exposure(int(random.integers(len(images))))]
