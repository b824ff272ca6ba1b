"""Filtering splats by the standard deviation of their depth and by opacity."""

import pytest
import torch

from sigmasplat.data.field import GaussianField
from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.outputs import chosen_splats
from sigmasplat.uncertainty.map_uncertainty import SplatStd


def three() -> GaussianField:
    """Return splats with opacities 0.9, 0.5, 0.1."""
    return GaussianField.from_values(
        torch.zeros(3, 3),
        torch.ones(3),
        torch.zeros(3, 3),
        opacities=torch.tensor([0.9, 0.5, 0.1]),
    )


def test_bounds_select_splats() -> None:
    for bounds, kept in [
        ({}, [True, True, True]),
        ({"opacity_above": 0.3}, [True, True, False]),
        ({"opacity_above": 1.0}, [False, False, False]),
    ]:
        assert chosen_splats.filter_splats(three(), **bounds).tolist() == kept


def test_a_bound_of_the_depth_drops_exactly_the_splats_above_it() -> None:
    std = SplatStd(torch.tensor([0.03, 0.01, 0.02]), torch.zeros(3))
    found = chosen_splats.filter_splats(three(), opacity_above=0.3, std_below_m=0.03, std=std)
    assert found.tolist() == [False, True, False]
    with pytest.raises(SigmaSplatError, match="standard deviations"):
        chosen_splats.filter_splats(three(), std_below_m=0.03)
