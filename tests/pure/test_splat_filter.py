"""Filtering splats by σ and opacity: σ as documented, correct masks."""

import math

import pytest
import torch

from sigmasplat.data.field import GaussianField
from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.outputs import chosen_splats
from sigmasplat.uncertainty.map_uncertainty import SplatStd


def three() -> GaussianField:
    """Return splats with σ 0.1, 0.2, 0.3 and opacities 0.9, 0.5, 0.1."""
    return GaussianField.from_values(
        torch.zeros(3, 3),
        torch.ones(3),
        torch.zeros(3, 3),
        opacities=torch.tensor([0.9, 0.5, 0.1]),
        log_variances=torch.tensor([0.1, 0.2, 0.3]).square().log()[:, None],
    )


def test_sigma_is_the_root_of_the_mean_variance() -> None:
    field = three()
    field.params[0, 14:17] = torch.tensor([0.01, 0.04, 0.25]).log()
    assert chosen_splats.sigmas(field).tolist() == pytest.approx([math.sqrt(0.1), 0.2, 0.3])


def test_bounds_select_splats() -> None:
    for bounds, kept in [
        ({}, [True, True, True]),
        ({"sigma_below": 0.25}, [True, True, False]),
        ({"opacity_above": 0.3}, [True, True, False]),
        ({"sigma_below": 0.25, "opacity_above": 0.7}, [True, False, False]),
        ({"sigma_below": 0.0}, [False, False, False]),
    ]:
        assert chosen_splats.filter_splats(three(), **bounds).tolist() == kept


def test_a_bound_of_the_depth_drops_exactly_the_splats_above_it() -> None:
    std = SplatStd(torch.tensor([0.03, 0.01, 0.02]), torch.zeros(3))
    found = chosen_splats.filter_splats(three(), sigma_below=0.25, opacity_above=0.3, std_below_m=0.03, std=std)
    assert found.tolist() == [False, True, False]
    with pytest.raises(SigmaSplatError, match="standard deviations"):
        chosen_splats.filter_splats(three(), std_below_m=0.03)


def test_a_new_map_has_no_learned_variance() -> None:
    assert not chosen_splats.has_learned_variance(
        GaussianField.from_values(torch.zeros(2, 3), torch.ones(2), torch.zeros(2, 3))
    )
    assert chosen_splats.has_learned_variance(three()) and not chosen_splats.has_learned_variance(GaussianField.empty())
