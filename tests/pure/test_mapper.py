"""The mapper on plain torch: how many seeds it takes in and how wide, what it prunes, fixes and freezes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from constants import changed
from map_now import map_now
from paper_settings import DensifyConfig, MappingConfig, RenderConfig, SeedConfig, paper_settings
from sigmasplat import config as settings
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS
from sigmasplat.data.frame import Frame
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.mapping.mapper import Mapper
from sigmasplat.render.reference import ReferenceView
from sigmasplat.types import completed, never

CAMERA = Camera(16, 12, 15.0, 15.0, 7.5, 5.5)
PIXELS = 16 * 12
NO_FIT = MappingConfig(iterations=0, first_iterations=0, prune_opacity=0.1)
EVERY_PIXEL = SeedConfig(
    first_uniform=PIXELS, first_gradient=0, first_edges=False, scale_from="pixel", opacity=0.5, density=1.0, later_max=0
)


def view() -> ReferenceView:
    return ReferenceView(CAMERA, RenderConfig())


def target(object_columns: int = 0) -> Target:
    """Show a wall at 2 m, and an object at 1 m before its left columns."""
    color = np.random.default_rng(object_columns).random((12, 16, 3)).astype(np.float32)
    depth = np.full((12, 16), 2.0, np.float32)
    depth[:, :object_columns] = 1.0
    return Target.of(Frame(0, 0.0, color, depth, CAMERA), (12, 16))


def mapper(seeding: SeedConfig = EVERY_PIXEL, mapping: MappingConfig = NO_FIT) -> Mapper:
    return Mapper(paper_settings(seeding=seeding, mapping=mapping), np.random.default_rng(0))


def test_seeds_are_as_wide_as_they_lie_apart() -> None:
    pixel_m = 2.0 / CAMERA.fx
    for share, spacing in ((1, 1.0), (4, 2.0)):
        made = mapper(changed(EVERY_PIXEL, first_uniform=PIXELS // share))
        map_now(made, view(), 0, target(), np.eye(4))
        assert len(made.field) == PIXELS // share
        assert float(made.field.scales.mean()) == pytest.approx(spacing * pixel_m, rel=1e-3)


def test_the_budget_of_splats_is_kept() -> None:
    for budget, splats in ((123, 123), (PIXELS + 20, PIXELS + 20), (0, PIXELS + 60)):
        made = mapper(changed(EVERY_PIXEL, max_splats=budget, opacity=0.95))
        map_now(made, view(), 0, target(), np.eye(4))
        map_now(made, view(), 1, target(object_columns=5), np.eye(4))
        assert len(made.field) == splats


def test_what_the_map_explains_is_not_seeded_again() -> None:
    made = mapper(changed(EVERY_PIXEL, opacity=0.95))
    map_now(made, view(), 0, target(), np.eye(4))
    map_now(made, view(), 1, target(), np.eye(4))
    assert len(made.field) == PIXELS
    map_now(made, view(), 2, target(object_columns=5), np.eye(4))
    assert len(made.field) == PIXELS + 5 * 12
    new = made.field.means[PIXELS:]
    assert float(new[:, 2].max()) < 1.1 and float(new[:, 0].max()) < 0.0, "the object, and nothing else"


DIVIDED = replace(NO_FIT, every=5, iterations=8, first_iterations=21, divided=True)


def keyframe(index: int) -> Keyframe:
    return Keyframe(index, target(), np.eye(4))


def test_half_of_the_steps_of_a_keyframe_are_divided_over_the_next_frames_where_asked() -> None:
    made, taken = mapper(mapping=DIVIDED), list[int]()

    def frames(count: int) -> None:
        for _ in range(count):
            before = made.field.steps
            completed(made.refining(view(), made.pending_now, never))
            taken.append(made.field.steps - before)

    assert len(completed(made.mapping(view(), keyframe(0))).losses) == 4
    frames(4)
    assert taken == [8, 8, 1, 0]  # the second half of 8 steps, and the other 13 that only the first keyframe has
    for index in (1, 2):
        taken.clear()
        assert len(completed(made.mapping(view(), keyframe(index))).losses) == 4
        frames(5)
        assert taken == [1, 1, 1, 1, 0]
    assert made.field.steps == 21 + 2 * 8


def test_a_keyframe_that_comes_early_finds_the_steps_of_the_one_before_made() -> None:
    made = mapper(mapping=replace(DIVIDED, first_iterations=8))
    completed(made.mapping(view(), keyframe(0)))
    completed(made.refining(view(), made.pending_now, never))
    completed(made.mapping(view(), keyframe(1)))
    assert (made.field.steps, made.pending) == (8 + 4, 4)
    assert len(map_now(made, view(), 2, target(), np.eye(4)).losses) == 8 and made.field.steps == 8 + 8 + 8


def test_splats_that_contradict_readings_are_removed_when_the_last_step_is_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A wall that is seen at 1 m is an error if all readings say 2 m. It is faded at once and goes after the last step,
    whether the steps are divided or not; what owns no pixel stays."""
    monkeypatch.setattr(settings.DensifyConfig, "faded_opacity", 0.05)  # below the opacity that recovers
    seeding = changed(EVERY_PIXEL, opacity=0.95)
    uncertain = DensifyConfig(uncertain_m2=0.025)
    fit = changed(NO_FIT, iterations=2, every=5, prune_opacity=0.01, lr_means=0.0, lr_opacity_logits=0.0)
    counts = list[int]()
    for divided in (False, True):
        config = paper_settings(seeding=seeding, mapping=replace(fit, divided=divided), primitives=uncertain)
        made = Mapper(config, np.random.default_rng(0))
        map_now(made, view(), 0, target(object_columns=16), np.eye(4))
        near = len(made.field)
        completed(made.mapping(view(), keyframe(1)))
        if divided:
            assert int((made.field.means[:, 2] < 1.5).sum()) == near
            completed(made.refining(view(), made.pending, never))
        counts.append(int((made.field.means[:, 2] < 1.5).sum()))
        assert near == PIXELS and made.half is None
    assert counts[0] == counts[1] < PIXELS / 4


def test_faded_splats_are_pruned() -> None:
    made = mapper(changed(EVERY_PIXEL, opacity=0.05))
    map_now(made, view(), 0, target(), np.eye(4))
    assert len(made.field) == 0 and len(made.keyframes) == 1


def test_the_first_keyframe_alone_is_fixed() -> None:
    made = mapper()
    for index in range(3):
        map_now(made, view(), index, target(), np.eye(4))
    assert [keyframe.fixed for keyframe in made.keyframes] == [True, False, False]
    assert [keyframe.index for keyframe in made.keyframes] == [0, 1, 2]


@pytest.mark.parametrize("frozen", [False, True])
def test_old_colours_are_frozen_where_asked(frozen: bool) -> None:
    made = mapper(mapping=changed(NO_FIT, iterations=2, colors="old-frozen" if frozen else "free"))
    map_now(made, view(), 0, target(), np.eye(4))
    old, colors = len(made.field), COLUMNS["colors"]
    before = made.field.params.clone()
    fit = map_now(made, view(), 1, target(object_columns=5), np.eye(4))
    assert len(fit.losses) == 2 and len(made.field) > old
    assert torch.equal(made.field.params[:old, colors], before[:, colors]) is frozen
    assert not torch.equal(made.field.params[:old, COLUMNS["means"]], before[:, COLUMNS["means"]])


@pytest.mark.parametrize("steps", [2, 6])
def test_all_colours_are_frozen_in_the_first_half_of_the_steps(steps: int) -> None:
    mapping = changed(NO_FIT, iterations=steps, first_iterations=steps, colors="code")
    made = mapper(changed(EVERY_PIXEL, opacity=0.6), mapping)
    slices = made.mapping(view(), keyframe(0))
    while made.half is None:  # the first half and what comes between the halves
        next(slices)
    seeds = target().image.reshape(-1, 3)
    assert torch.equal(made.field.params[:, COLUMNS["colors"]], seeds)
    completed(slices)
    assert not torch.equal(made.field.params[:, COLUMNS["colors"]], seeds)


def test_a_keyframe_forgets_adams_moments_where_asked() -> None:
    """Without a step at the second keyframe, only forgetting changes the moments of the first one."""
    for fresh in (False, True):
        mapping = changed(NO_FIT, first_iterations=3, colors="code" if fresh else "free")
        made = mapper(changed(EVERY_PIXEL, opacity=0.95), mapping)
        map_now(made, view(), 0, target(), np.eye(4))
        assert made.field.steps == 3 and bool(made.field.moment2.any())
        map_now(made, view(), 1, target(), np.eye(4))
        assert bool(made.field.moment2.any()) == (not fresh) and made.field.steps == (0 if fresh else 3)


def test_a_keyframe_whose_pose_mapping_moves_is_not_divided() -> None:
    """Frames are tracked from its pose at once, so it must be final."""
    made = mapper(mapping=replace(DIVIDED, first_iterations=0, iterations=4, lr_pose_translation=1e-3))
    completed(made.mapping(view(), keyframe(0)))
    assert len(completed(made.mapping(view(), keyframe(1))).losses) == 4 and made.pending == 0
