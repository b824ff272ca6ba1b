"""Splits, clones and splats too large: what children inherit, where they lie, who is counted hot."""

import numpy as np
import pytest
import torch
from torch import Tensor

from paper_settings import DensifyConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import ATTRIBUTES, COLUMNS, WIDTH, GaussianField
from sigmasplat.fit.adam import Rates, adam_step
from sigmasplat.fit.field import DensifyStats
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.mapping.densify import copies, densify_mask, multiply, split, too_large, too_wide
from sigmasplat.render import reference

CAMERA = Camera(40, 30, 50.0, 52.0, 18.6, 15.3)
MOVED = [*range(0, 3), *range(7, 10)]
KEPT = [k for k in range(WIDTH) if k not in MOVED]


def aged(n: int = 6) -> GaussianField:
    """Make n different splats with Adam's state and both attributes, ids from 50 on."""
    torch.manual_seed(0)
    field = GaussianField(torch.randn(n, WIDTH))
    field.moment1, field.moment2 = torch.randn(n, WIDTH), torch.rand(n, WIDTH)
    field.last_step, field.steps = torch.full((n,), 9, dtype=torch.int32), 9
    for name, width in ATTRIBUTES.items():
        attribute = field.get_or_create(name)
        attribute.params, attribute.moment1, attribute.moment2 = (
            torch.randn(n, width),
            torch.randn(n, width),
            torch.rand(n, width),
        )
        attribute.last_step, attribute.steps = torch.full((n,), 9, dtype=torch.int32), 9
    field.ids, field.next_id = torch.arange(50, 50 + n), 50 + n
    return field


def mask(n: int, *rows: int) -> Tensor:
    chosen = torch.zeros(n, dtype=torch.bool)
    chosen[list(rows)] = True
    return chosen


def assert_at_rest(field: GaussianField, first: int) -> None:
    """Hold rows from `first` on to be as new, in the field and its attributes."""
    for rows in (field, *field.attributes.values()):
        assert not rows.moment1[first:].any() and not rows.moment2[first:].any() and not rows.last_step[first:].any()
        assert len(rows) == len(rows.moment1) == len(rows.moment2) == len(rows.last_step) == len(field)
        assert rows.steps == 9


def assert_untouched(field: GaussianField, before: GaussianField, rows: list[int]) -> None:
    """Hold the first rows of a field to be those rows of another, with all they carry."""
    n = len(rows)
    assert field.ids[:n].tolist() == before.ids[rows].tolist()
    for now, then in ((field, before), *((field.attributes[name], before.attributes[name]) for name in ATTRIBUTES)):
        for a, b in zip(now._tensors, then._tensors, strict=True):
            assert torch.equal(a[:n], b[rows])


def test_a_split_replaces_its_splat_by_two_that_inherit_all_but_place_and_size() -> None:
    field, before = aged(), aged()
    split(field, mask(6, 1, 4), np.random.default_rng(0))
    assert len(field) == 8
    assert_untouched(field, before, [0, 2, 3, 5])
    assert field.ids[4:].tolist() == [56, 57, 58, 59] and field.next_id == 60
    parents = [1, 1, 4, 4]
    assert torch.equal(field.params[4:][:, KEPT], before.params[parents][:, KEPT])
    for name in ATTRIBUTES:
        assert torch.equal(field.attributes[name].params[4:], before.attributes[name].params[parents])
    torch.testing.assert_close(field.scales[4:], before.scales[parents] / 1.6)
    assert_at_rest(field, 4)
    assert len({tuple(row.tolist()) for row in field.means}) == 8, "no two in one place"


def test_children_are_drawn_from_their_parents_gaussian() -> None:
    n, opacity = 20_000, 0.8
    quat = torch.tensor([0.3, -0.5, 0.9, 0.2])
    scales, mean = torch.tensor([0.5, 0.02, 0.1]), torch.tensor([4.0, -2.0, 1.0])
    field = GaussianField.from_values(
        mean.repeat(n, 1), scales.repeat(n, 1), torch.rand(n, 3), quats=quat.repeat(n, 1), opacities=opacity
    )
    split(field, torch.ones(n, dtype=torch.bool), np.random.default_rng(0))
    R = reference.rotations(quat[None])[0].double()
    steps = ((field.means - mean).double() @ R / scales).numpy()
    assert np.abs(steps.mean(0)).max() < 4 / np.sqrt(2 * n), "the centre of mass stays"
    np.testing.assert_allclose(steps.T @ steps / (2 * n), np.eye(3), atol=6 / np.sqrt(2 * n))
    assert np.linalg.norm(steps, axis=1).max() < 6.5
    siblings = (steps[::2] * steps[1::2]).mean(0)
    assert np.abs(siblings).max() < 4 / np.sqrt(n), "one child's place says nothing of its sibling's"


def test_chance_follows_from_the_generator() -> None:
    fields = [aged() for _ in range(3)]
    for field, seed in zip(fields, (1, 1, 2), strict=True):
        split(field, mask(6, 0, 5), np.random.default_rng(seed))
    assert torch.equal(fields[0].params, fields[1].params) and not torch.equal(fields[0].params, fields[2].params)


def test_a_turned_field_splits_into_turned_children() -> None:
    move = torch.from_numpy(se3.exp(np.array([1.0, 2.0, -1.0, 0.4, 0.7, -1.2])))
    here, there = aged(), aged().moved(move)
    for field in (here, there):
        split(field, mask(6, 2, 3), np.random.default_rng(4))
    torch.testing.assert_close(there.means, here.moved(move).means, rtol=1e-4, atol=1e-4)


def clone(field: GaussianField, rows: torch.Tensor) -> None:
    field.append(copies(field, rows))


def test_a_clone_stands_where_its_splat_does() -> None:
    for rows in (mask(6, 3, 5), torch.tensor([3, 5])):
        field, before = aged(), aged()
        clone(field, rows)
        assert_untouched(field, before, list(range(6)))
        assert torch.equal(field.params[6:], before.params[[3, 5]])
        assert torch.equal(field.attributes["harmonics"].params[6:], before.attributes["harmonics"].params[[3, 5]])
        assert field.ids[6:].tolist() == [56, 57]
        assert_at_rest(field, 6)
        field.params[6:] += 1.0
        assert torch.equal(field.params[:6], before.params), "a copy, not the same memory"


def test_nothing_hot_nothing_changed() -> None:
    field, before = aged(), aged()
    split(field, mask(6), np.random.default_rng(0))
    clone(field, mask(6))
    assert len(field) == 6 and field.next_id == 56
    assert_untouched(field, before, list(range(6)))
    empty = GaussianField.empty()
    split(empty, mask(0), np.random.default_rng(0))
    assert len(empty) == 0


def test_children_can_be_fitted_on() -> None:
    """Their first step has the length of any splat's first step, whatever their parents' moments were."""
    field = aged()
    split(field, mask(6, 1), np.random.default_rng(0))
    clone(field, mask(7, 0))
    before, grad, rates = field.params.clone(), torch.ones_like(field.params), Rates(torch.full((WIDTH,), 0.01))
    fresh = GaussianField(before[-3:].clone(), steps=9)
    for f, g in ((field, grad), (fresh, grad[-3:])):
        f.steps += 1
        adam_step(f, g, rates, torch.ones(len(f), dtype=torch.bool))
    assert torch.isfinite(field.params).all()
    torch.testing.assert_close(field.params[-3:], fresh.params)


@pytest.mark.parametrize("with_clones", [False, True])
def test_large_ones_are_split_and_small_ones_cloned_where_asked(with_clones: bool) -> None:
    field, before = aged(), aged()
    for f in (field, before):
        f.params[:, COLUMNS["log_scales"]] = torch.tensor([0.04, 0.06, 0.04, 0.06, 0.04, 0.06]).log()[:, None] - 0.5
        f.params[:, COLUMNS["log_scales"].start + 1] += 0.5  # the largest of the three counts
    config = DensifyConfig(split_scale_m=0.05, clone=with_clones)
    was_split = multiply(field, mask(6, 0, 1, 2, 3), config, np.random.default_rng(0))
    assert was_split.tolist() == mask(6, 1, 3).tolist()
    assert_untouched(field, before, [0, 2, 4, 5])
    twins = [0, 2] if with_clones else []
    assert len(field) == 4 + 4 + len(twins)
    torch.testing.assert_close(field.scales[4:8], before.scales[[1, 1, 3, 3]] / 1.6)
    assert torch.equal(field.params[8:], before.params[twins])
    assert sorted(field.ids[4:].tolist()) == list(range(56, 56 + 4 + len(twins)))
    assert_at_rest(field, 4)


def seen() -> Keyframe:
    return Keyframe(0, Target(CAMERA, torch.zeros(3, 30, 40), torch.zeros(30, 40), 0), np.eye(4))


def test_densification_uses_the_mean_gradient_over_the_steps_that_saw_a_splat() -> None:
    newest, other = seen(), seen()
    stats = DensifyStats.of(newest, 4)
    for grad2d in ([2.0, 0.0, 0.5, 0.0], [0.0, 0.0, 0.7, 1.0], [4.0, 0.0, 0.6, 0.0]):
        stats.on_gradient(newest, torch.tensor(grad2d))
        stats.on_gradient(other, torch.tensor([9.0] * 4))  # of another keyframe: ignored
    assert stats.times.tolist() == [2, 0, 3, 1]
    torch.testing.assert_close(stats.grad2d, torch.tensor([6.0, 0.0, 1.8, 1.0]))
    assert densify_mask(stats, 1.0).tolist() == [True, False, False, True]
    assert densify_mask(stats, 0.55).tolist() == [True, False, True, True]
    assert densify_mask(stats, 3.01).tolist() == [False] * 4
    assert densify_mask(stats, 0.0).tolist() == [False] * 4, "off"


def test_statistics_copy_the_gradients_they_are_given() -> None:
    keyframe, grad2d = seen(), torch.tensor([1.0, 2.0])
    stats = DensifyStats.of(keyframe, 2)
    stats.on_gradient(keyframe, grad2d)
    stats.on_gradient(keyframe, grad2d)
    assert grad2d.tolist() == [1.0, 2.0] and stats.grad2d.tolist() == [2.0, 4.0]
    assert DensifyStats.of(keyframe, 2).grad2d.tolist() == [0.0, 0.0]


def test_a_budget_goes_to_the_largest_gradients() -> None:
    grad2d, times = torch.tensor([2.0, 9.0, 3.0, 3.0, 0.1]), torch.tensor([1.0, 3.0, 1.0, 1.0, 0.0])
    stats = DensifyStats(seen(), grad2d, times)
    assert densify_mask(stats, 1.0).tolist() == [True, True, True, True, False]
    for most, chosen in ((5, [0, 1, 2, 3]), (3, [1, 2, 3]), (2, [1, 2]), (1, [1]), (0, []), (-4, [])):
        assert densify_mask(stats, 1.0, most).nonzero().squeeze(1).tolist() == chosen


def splat_at(x: float, y: float, z: float, scale_m: float) -> GaussianField:
    scales = torch.tensor([[scale_m / 5, scale_m, scale_m / 2]])
    return GaussianField.from_values(torch.tensor([[x, y, z]]), scales, torch.rand(1, 3))


def test_a_splat_is_too_large_by_its_greatest_scale() -> None:
    for scale, large in ((0.19, False), (0.21, True)):
        for place in ((0.0, 0.0, 2.0), (0.0, 0.0, -2.0), (90.0, 0.0, 2.0)):
            assert too_large(splat_at(*place, scale), 0.2).tolist() == [large]
    assert too_large(splat_at(0.0, 0.0, 2.0, 99.0), 0.0).tolist() == [False], "off"
    assert too_large(GaussianField.empty(), 0.2).tolist() == []


def test_a_splat_is_too_wide_in_the_image_by_three_sigmas() -> None:
    eye = np.eye(4)
    least = 20.0 * 2.0 / 50.0 / 3.0
    for factor, large in ((0.99, False), (1.01, True)):
        assert too_wide(splat_at(0.0, 0.0, 2.0, factor * least), eye, CAMERA, 20.0).tolist() == [large]
        assert too_wide(splat_at(0.0, 0.0, 4.0, 2 * factor * least), eye, CAMERA, 20.0).tolist() == [large]
    assert too_wide(GaussianField.empty(), eye, CAMERA, 20.0).tolist() == []


def test_only_what_the_image_shows_is_measured_in_it() -> None:
    for u, v, z, seen in [
        (0.0, 0.0, 2.0, True), (39.4, 29.4, 2.0, True), (-0.6, 9.0, 2.0, False), (39.6, 9.0, 2.0, False),
        (9.0, -0.6, 2.0, False), (9.0, 29.6, 2.0, False), (9.0, 9.0, -2.0, False),
    ]:  # fmt: skip
        T = se3.exp(np.array([0.4, -0.2, 0.6, 0.3, -0.5, 0.2]))
        field = splat_at((u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z, 1.0)
        moved = field.moved(torch.from_numpy(se3.inverse(T)))
        assert too_wide(moved, T, CAMERA, 20.0).tolist() == [seen]
