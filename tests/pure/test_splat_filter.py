"""Filtering splats by σ and opacity: σ as documented, correct masks and counts."""

import math

import pytest
import torch

from sigmasplat.data.field import GaussianField
from sigmasplat.data.map_uncertainty import SplatStd
from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.outputs import chosen_splats


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


def test_bounds_select_splats_and_count_the_others() -> None:
    for bounds, kept, by_sigma, by_opacity in [
        ({}, [True, True, True], 0, 0),
        ({"sigma_below": 0.25}, [True, True, False], 1, 0),
        ({"opacity_above": 0.3}, [True, True, False], 0, 1),
        ({"sigma_below": 0.25, "opacity_above": 0.7}, [True, False, False], 1, 1),
        ({"sigma_below": 0.0}, [False, False, False], 3, 0),
    ]:
        found = chosen_splats.filter_splats(three(), **bounds)
        assert (found.kept.tolist(), found.by_sigma, found.by_opacity) == (kept, by_sigma, by_opacity)
        assert found.dropped == kept.count(False)


def test_a_bound_of_the_depth_drops_exactly_the_splats_above_it() -> None:
    std = SplatStd(torch.tensor([0.03, 0.01, 0.02]), torch.zeros(3))
    found = chosen_splats.filter_splats(three(), sigma_below=0.25, opacity_above=0.3, std_below_m=0.03, std=std)
    assert (found.kept.tolist(), found.by_sigma, found.by_std, found.by_opacity) == ([False, True, False], 1, 1, 0)
    assert found.dropped == 2
    with pytest.raises(SigmaSplatError, match="standard deviations"):
        chosen_splats.filter_splats(three(), std_below_m=0.03)


def test_a_new_map_has_no_learned_variance() -> None:
    assert not chosen_splats.has_learned_variance(
        GaussianField.from_values(torch.zeros(2, 3), torch.ones(2), torch.zeros(2, 3))
    )
    assert chosen_splats.has_learned_variance(three()) and not chosen_splats.has_learned_variance(GaussianField.empty())
