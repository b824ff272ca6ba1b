"""Limits of the shapes of splats: ratios hold afterwards, other splats and other columns keep their values."""

import torch

from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.final.refinement import limit_shapes

BALL, DISC, NEEDLE, BLADE = (0.1, 0.1, 0.1), (0.2, 0.001, 0.2), (0.01, 0.01, 0.9), (0.0001, 0.9, 0.02)
SCALES = COLUMNS["log_scales"]


def shapes() -> GaussianField:
    """Make one splat of each shape, halfway through a fit."""
    scales = torch.tensor([BALL, DISC, NEEDLE, BLADE])
    field = GaussianField.from_values(torch.zeros(4, 3), scales, torch.full((4, 3), 0.5))
    field.moment1.fill_(0.3)
    field.moment2.fill_(0.2)
    return field


def sorted_axes(field: GaussianField) -> torch.Tensor:
    return field.scales.sort(1, descending=True).values


def test_without_limits_nothing_changes() -> None:
    field, before = shapes(), shapes()
    limit_shapes(field, 0.0, 0.0)
    assert torch.equal(field.params, before.params) and torch.equal(field.moment1, before.moment1)


def test_the_shorter_axes_are_lengthened() -> None:
    field, before = shapes(), shapes()
    limit_shapes(field, 10.0, 0.0)
    axes = sorted_axes(field)
    assert float((axes[:, 0] / axes[:, 2]).max()) < 10.001
    torch.testing.assert_close(axes[:, 0], sorted_axes(before)[:, 0])
    torch.testing.assert_close(field.scales[1], torch.tensor([0.2, 0.02, 0.2]))


def test_the_longest_axis_is_shortened_first() -> None:
    field = shapes()
    limit_shapes(field, 10.0, 5.0)
    torch.testing.assert_close(field.scales[2], torch.tensor([0.01, 0.01, 0.05]))
    torch.testing.assert_close(field.scales[3], torch.tensor([0.01, 0.1, 0.02]))


def test_only_changed_axes_lose_their_moments() -> None:
    field, before = shapes(), shapes()
    limit_shapes(field, 10.0, 5.0)
    changed = field.params != before.params
    assert not changed[0].any() and changed[1, SCALES].tolist() == [False, True, False]
    assert not field.moment1[changed].any() and not field.moment2[changed].any()
    assert torch.equal(field.moment1[~changed], before.moment1[~changed])
