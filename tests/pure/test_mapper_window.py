"""The mapper's window, whose poses move and when, doubted and hot splats, the first keyframe's rates."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from constants import changed
from map_now import map_now
from paper_settings import DensifyConfig, MappingConfig, RenderConfig, SeedConfig, paper_settings
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.mapping import mapper as mapper_module
from sigmasplat.mapping.mapper import Mapper
from sigmasplat.render.reference import ReferenceView

CAMERA = Camera(16, 12, 44.0 / 3, 44.0 / 3, 7.5, 5.5)
SEEDS = SeedConfig(
    first_uniform=10_000, first_gradient=0, first_edges=False, scale_from="pixel", later_max=0, opacity=0.9,
    density=1.0, push_back=1.0,
)  # fmt: skip
FITTED = MappingConfig(
    iterations=6, first_iterations=6, weight_nll_color=0.0, prune_opacity=0.005, window=4, frames_per_step=0,
    weight_alignment=0.25, weight_moment=0.15, lr_pose_translation=1e-3, lr_pose_rotation=1e-3,
)  # fmt: skip


FEW = replace(FITTED, iterations=2, first_iterations=2, window=3)


def view() -> ReferenceView:
    return ReferenceView(CAMERA, RenderConfig(), variance=False)


def target(depth_m: float = 2.0) -> Target:
    """Show a wall with a pattern."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    color = 0.5 + 0.4 * np.stack([np.sin(u / 2.0), np.cos(v / 2.0), np.sin((u + v) / 3.0)], -1)
    depth = np.full((CAMERA.height, CAMERA.width), depth_m)
    return Target.of(
        Frame(0, 0.0, color.astype(np.float32), depth.astype(np.float32), CAMERA), (CAMERA.height, CAMERA.width)
    )


def shifted(x_m: float) -> np.ndarray:
    return se3.exp(np.array([x_m, 0.0, 0.0, 0.0, 0.0, 0.0]))


def mapper(mapping: MappingConfig = FITTED, primitives: Any = None, **seeding: Any) -> Mapper:
    config = paper_settings(
        mapping=mapping, primitives=primitives or DensifyConfig(), seeding=changed(SEEDS, **seeding)
    )
    return Mapper(config, np.random.default_rng(0))


def mapped(made: Mapper, places_m: Sequence[float]) -> Mapper:
    for index, x_m in enumerate(places_m):
        map_now(made, view(), index, target(), shifted(x_m))
    return made


@pytest.fixture
def looked_at(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """Write down the keyframes of every batch a mapper fits to."""
    batches: list[list[int]] = []
    fit = mapper_module.fitting

    def watched(field: Any, view: Any, drawn: Iterator[list[Keyframe]], *rest: Any, **named: Any) -> Any:
        kept = list(drawn)
        batches.extend([keyframe.index for keyframe in batch] for batch in kept)
        return fit(field, view, kept, *rest, **named)

    monkeypatch.setattr(mapper_module, "fitting", watched)
    return batches


def test_only_the_window_is_looked_at_all_of_it_in_every_step(looked_at: list[list[int]]) -> None:
    """From the start one goes far away and comes back: then the first keyframe shares most, not the ones far off."""
    mapped(mapper(FEW), (0.0, 3.0, 3.2, 3.1, 0.05))
    last = looked_at[-FEW.iterations :]
    assert all(sorted(batch) == [0, 3, 4] for batch in last), "the newest, the one before it, the one that shares most"


def test_a_submap_that_inherits_splats_chooses_its_window_by_them(looked_at: list[list[int]]) -> None:
    """The first keyframe of such a submap is not fitted, but later windows compare it with the newest keyframe."""
    before = mapper(FEW)
    before.config = before.config.changed(submaps={"inherit": True})
    made = mapped(mapped(before, (0.0,)).successor(view(), np.eye(4)), (0.0, 3.0, 3.2, 3.1, 0.05))
    assert [keyframe.index for keyframe in made.keyframes] == [0, 1, 2, 3, 4]
    assert sorted(looked_at[-1]) == [0, 3, 4], "the newest, the one before it, and the first"


def test_one_of_the_window_a_step(looked_at: list[list[int]]) -> None:
    mapped(mapper(changed(FITTED, window=2, frames_per_step=1, iterations=30)), (0.0, 0.1, 0.2))
    assert {len(batch) for batch in looked_at} == {1}
    assert {batch[0] for batch in looked_at[-30:]} == {1, 2}


@pytest.mark.parametrize(("poses", "moving"), [("all", {1, 2}), ("newest", {2})])
def test_whose_poses_move(poses: Any, moving: set[int]) -> None:
    made = mapped(mapper(changed(FITTED, poses=poses)), (0.0, 0.1))
    before = [k.T_world_camera.copy() for k in made.keyframes] + [shifted(0.2)]
    map_now(made, view(), 2, target(), shifted(0.2))
    moved = {k.index for k, T in zip(made.keyframes, before, strict=True) if not np.array_equal(k.T_world_camera, T)}
    assert moved == moving, "the first keyframe holds the gauge"


def test_poses_move_in_the_second_half_only() -> None:
    """Of two steps the first leaves poses alone: after it the pose has had one step of Adam, not two."""
    steps = {}
    for start in ("start", "half"):
        made = mapper(changed(FITTED, iterations=2, poses_from=start))
        mapped(made, (0.0, 0.1))
        steps[start] = made.keyframes[1].motion.steps
    assert steps == {"start": 2, "half": 1}


def floater(made: Mapper) -> int:
    """Put an opaque splat half way before the wall; return its id."""
    made.field.append(
        GaussianField.from_values(
            torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([0.05]), torch.full((1, 3), 0.9), opacities=0.95
        )
    )
    return int(made.field.ids[-1])


def test_a_floater_is_doubted_and_goes_the_wall_stays() -> None:
    made = mapped(mapper(replace(FITTED, iterations=20), DensifyConfig(uncertain_m2=0.025)), (0.0,))
    made.config = replace(made.config, seeding=changed(SEEDS, depth_error_factor=0.0))
    wall, floating = set(made.field.ids.tolist()), floater(made)
    map_now(made, view(), 1, target(), shifted(0.02))
    left = set(made.field.ids.tolist())
    assert floating not in left
    assert len(wall - left) < 0.02 * len(wall)


def test_without_doubt_the_floater_stays() -> None:
    made = mapped(mapper(), (0.0,))
    floating = floater(made)
    map_now(made, view(), 1, target(), shifted(0.02))
    assert floating in made.field.ids.tolist()


def test_hot_splats_are_split_within_the_budget() -> None:
    hot = DensifyConfig(split_gradient=1e-7, split_scale_m=1e-3)
    free, count = mapped(mapper(), (0.0,)), CAMERA.width * CAMERA.height
    assert len(free.field) == count
    assert len(mapped(mapper(primitives=hot), (0.0,)).field) > 1.5 * count
    tight = mapped(mapper(primitives=hot, max_splats=count + 50), (0.0,))
    assert count < len(tight.field) <= count + 50


def test_old_colours_stay_frozen_when_rows_move() -> None:
    """Splits of old splats shift rows between the halves: frozen are those that are old, wherever they stand."""
    mapping = changed(FITTED, colors="old-frozen", lr_colors=0.05)
    made = mapped(mapper(mapping, DensifyConfig(split_gradient=1e-7, split_scale_m=0.2), opacity=0.5), (0.0,))
    made.field.params[:40, COLUMNS["log_scales"]] = float(np.log(0.3))
    old = dict(zip(made.field.ids.tolist(), made.field.colors.clone(), strict=True))
    map_now(made, view(), 1, target(), shifted(0.4))
    kept = [k for k, i in enumerate(made.field.ids.tolist()) if i in old]
    assert 0 < len(kept) < len(old), "some were split"
    for k in kept:
        assert torch.equal(made.field.colors[k], old[int(made.field.ids[k])])


def test_too_large_splats_go() -> None:
    made = mapped(mapper(primitives=DensifyConfig(most_scale_m=0.5)), (0.0,))
    made.field.params[3, COLUMNS["log_scales"]] = float(np.log(0.8))
    large = int(made.field.ids[3])
    map_now(made, view(), 1, target(), shifted(0.02))
    assert large not in made.field.ids.tolist()


def test_the_first_keyframes_rates_fall_evenly_in_log() -> None:
    config = MappingConfig(lr_means=1e-3, lr_means_first=4e-3)
    means = [float(rates.per_column[0]) for rates in Rates.falling(config, 5)]
    assert means == pytest.approx([4e-3, 4e-3 * 0.25**0.25, 2e-3, 4e-3 * 0.25**0.75, 1e-3], rel=1e-5)
    others = [rates.per_column[3:] for rates in Rates.falling(config, 5)]
    assert all(torch.equal(rates, Rates.of(config).per_column[3:]) for rates in others)
    assert [float(r.per_column[0]) for r in Rates.falling(replace(config, lr_means_first=0.0), 2)] == pytest.approx(
        [1e-3] * 2
    )


def test_what_the_camera_comes_close_to_is_split_as_far_as_the_budget_goes() -> None:
    """From a third of the distance seeds span three times as many pixels, and there are hardly any new ones."""
    close = {}
    for split_px, budget in ((0.0, 0), (6.0, 0), (6.0, 500)):
        made = mapped(mapper(primitives=DensifyConfig(split_radius_px=split_px), max_splats=budget), (0.0,))
        map_now(made, view(), 1, target(2.0 / 3.0), se3.exp(np.array([0.0, 0.0, 4.0 / 3.0, 0.0, 0.0, 0.0])))
        close[split_px, budget] = len(made.field)
    count = CAMERA.width * CAMERA.height
    assert close[0.0, 0] < 1.1 * count and close[6.0, 0] > close[0.0, 0] + 0.08 * count
    assert count < close[6.0, 500] <= 500
