"""The mapper on plain torch: how many seeds it takes in and how wide, what it prunes, fixes and freezes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sigmasplat.config import Config, MappingConfig, RenderConfig, SeedConfig
from sigmasplat.fit.target import Target
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import COLUMNS
from sigmasplat.model.frame import Frame
from sigmasplat.render.reference.view import ReferenceView
from sigmasplat.slam.mapper import Mapper
from sigmasplat.types import completed

CAMERA = Camera(16, 12, 15.0, 15.0, 7.5, 5.5)
PIXELS = 16 * 12
NO_FIT = MappingConfig(iterations=0, first_iterations=0, prune_opacity=0.1)
EVERY_PIXEL = SeedConfig(first_uniform=PIXELS, first_gradient=0, first_edges=False, scale_from="pixel", later_max=0)


def view() -> ReferenceView:
    return ReferenceView(CAMERA, RenderConfig())


def target(object_columns: int = 0) -> Target:
    """Show a wall at 2 m, and an object at 1 m before its left columns."""
    color = np.random.default_rng(object_columns).random((12, 16, 3)).astype(np.float32)
    depth = np.full((12, 16), 2.0, np.float32)
    depth[:, :object_columns] = 1.0
    return Target.of(Frame(0, 0.0, color, depth, CAMERA), (12, 16))


def mapper(seeding: SeedConfig = EVERY_PIXEL, mapping: MappingConfig = NO_FIT) -> Mapper:
    return Mapper(Config(seeding=seeding, mapping=mapping), np.random.default_rng(0))


def test_seeds_are_as_wide_as_they_lie_apart() -> None:
    pixel_m = 2.0 / CAMERA.fx
    for share, spacing in ((1, 1.0), (4, 2.0)):
        made = mapper(replace(EVERY_PIXEL, first_uniform=PIXELS // share))
        made.map(view(), 0, target(), np.eye(4))
        assert len(made.field) == PIXELS // share
        assert float(made.field.scales.mean()) == pytest.approx(spacing * pixel_m, rel=1e-3)


def test_the_budget_of_splats_is_kept() -> None:
    for budget, splats in ((123, 123), (PIXELS + 20, PIXELS + 20), (0, PIXELS + 60)):
        made = mapper(replace(EVERY_PIXEL, max_splats=budget, opacity=0.95))
        made.map(view(), 0, target(), np.eye(4))
        made.map(view(), 1, target(object_columns=5), np.eye(4))
        assert len(made.field) == splats


def test_what_the_map_explains_is_not_seeded_again() -> None:
    made = mapper(replace(EVERY_PIXEL, opacity=0.95))
    made.map(view(), 0, target(), np.eye(4))
    made.map(view(), 1, target(), np.eye(4))
    assert len(made.field) == PIXELS
    made.map(view(), 2, target(object_columns=5), np.eye(4))
    assert len(made.field) == PIXELS + 5 * 12
    new = made.field.means[PIXELS:]
    assert float(new[:, 2].max()) < 1.1 and float(new[:, 0].max()) < 0.0, "the object, and nothing else"


def test_the_steps_of_the_first_keyframe_are_divided_where_asked() -> None:
    made = mapper(mapping=replace(NO_FIT, iterations=2, first_iterations=7, first_divided=True))
    assert len(made.map(view(), 0, target(), np.eye(4)).losses) == 2
    taken = list[int]()
    while made.owed:
        completed(made.refining(view(), min(2, made.owed), lambda: False))
        taken.append(made.field.steps)
    assert taken == [4, 6, 7]
    assert len(made.map(view(), 1, target(), np.eye(4)).losses) == 2
    assert not made.owed  # only the first keyframe of a map has more steps


def test_faded_splats_are_pruned() -> None:
    made = mapper(replace(EVERY_PIXEL, opacity=0.05))
    made.map(view(), 0, target(), np.eye(4))
    assert len(made.field) == 0 and len(made.keyframes) == 1


def test_the_first_keyframe_alone_is_fixed() -> None:
    made = mapper()
    for index in range(3):
        made.map(view(), index, target(), np.eye(4))
    assert [keyframe.fixed for keyframe in made.keyframes] == [True, False, False]
    assert [keyframe.index for keyframe in made.keyframes] == [0, 1, 2]


@pytest.mark.parametrize("frozen", [False, True])
def test_old_colours_are_frozen_where_asked(frozen: bool) -> None:
    made = mapper(mapping=replace(NO_FIT, iterations=2, freeze_old_colors=frozen))
    made.map(view(), 0, target(), np.eye(4))
    old, colors = len(made.field), COLUMNS["colors"]
    before = made.field.params.clone()
    fit = made.map(view(), 1, target(object_columns=5), np.eye(4))
    assert len(fit.losses) == 2 and len(made.field) > old
    assert torch.equal(made.field.params[:old, colors], before[:, colors]) is frozen
    assert not torch.equal(made.field.params[:old, COLUMNS["means"]], before[:, COLUMNS["means"]])


@pytest.mark.parametrize("until", ["end", "half"])
def test_all_colours_are_frozen_to_the_end_or_to_half_of_the_steps(until: str) -> None:
    mapping = replace(NO_FIT, iterations=6, first_iterations=6, freeze_new_colors=True, freeze_until=until)
    made = mapper(replace(EVERY_PIXEL, opacity=0.6), mapping)
    made.map(view(), 0, target(), np.eye(4))
    seeds = target().image.reshape(-1, 3)
    assert torch.equal(made.field.params[:, COLUMNS["colors"]], seeds) == (until == "end")
    before = made.field.params[:, COLUMNS["colors"]].clone()
    made.map(view(), 1, target(object_columns=5), np.eye(4))
    assert torch.equal(made.field.params[: len(before), COLUMNS["colors"]], before) == (until == "end")


def test_a_keyframe_forgets_adams_moments_where_asked() -> None:
    """Without a step at the second keyframe, only forgetting changes the moments of the first one."""
    for fresh in (False, True):
        mapping = replace(NO_FIT, first_iterations=3, fresh_adam=fresh)
        made = mapper(replace(EVERY_PIXEL, opacity=0.95), mapping)
        made.map(view(), 0, target(), np.eye(4))
        assert made.field.steps == 3 and bool(made.field.moment2.any())
        made.map(view(), 1, target(), np.eye(4))
        assert bool(made.field.moment2.any()) == (not fresh) and made.field.steps == (0 if fresh else 3)
