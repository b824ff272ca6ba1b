"""Sums over the pixels of a splat, and values of splats in an image, on every view against the definition."""

import pytest
import torch
from torch import Tensor

from sigmasplat.model.field import COLUMNS
from sigmasplat.render.splat_sums import accumulate, render_values
from splat_fields import exact_view, params_of, view_on
from splat_scenes import KINDS, WIDE, assert_same_vector, scene


def planes(seed: int = 0) -> Tensor:
    """Draw three planes [3, H, W] ≥ 0."""
    return torch.rand(3, WIDE.height, WIDE.width, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
@pytest.mark.parametrize("kind", KINDS)
def test_sums_and_values_agree_with_the_definition(kernels: str, kind: str, variance: bool) -> None:
    s = scene(kind, 60, WIDE)
    params, T = params_of(s), s.T_camera_world.numpy()
    values = torch.rand(60, 3, generator=torch.Generator().manual_seed(1))
    view, exact = view_on(kernels, WIDE, variance), exact_view(WIDE, variance)
    want = accumulate(exact, params.double(), T, planes().double())
    assert float(want.min()) >= 0.0 and float(want.max()) > 0.0
    assert_same_vector(accumulate(view, params, T, planes()), want, what=f"sums of {kind}")
    want = render_values(exact, params.double(), T, values.double())
    assert_same_vector(render_values(view, params, T, values), want, what=f"values of {kind}")


@pytest.mark.parametrize("name", ["cpu", "reference"])
def test_a_sum_is_the_transpose_of_a_render(name: str) -> None:
    s = scene("random", 60, WIDE)
    params, T = params_of(s).double() if name == "reference" else params_of(s), s.T_camera_world.numpy()
    view = exact_view(WIDE, True) if name == "reference" else view_on("cpu", WIDE)
    values = torch.rand(60, 3, generator=torch.Generator().manual_seed(1)).to(params)
    g = planes().to(params)
    over_pixels = (g * render_values(view, params, T, values)).sum((1, 2))
    over_splats = (values * accumulate(view, params, T, g)).sum(0)
    torch.testing.assert_close(over_pixels, over_splats, rtol=1e-4, atol=0.0)


def test_sums_ignore_variances_and_old_gradients() -> None:
    s = scene("random", 60, WIDE)
    params, T, view = params_of(s), s.T_camera_world.numpy(), view_on("cpu", WIDE)
    fresh = accumulate(view, params, T, planes())
    changed = params.clone()
    changed[:, COLUMNS["log_variances"]] += 3.0
    view.g_sums.fill_(1.0)
    view.g_alpha.fill_(1.0)
    assert torch.equal(accumulate(view, changed, T, planes()), fresh)


def test_ones_sum_to_the_weights_of_the_splats() -> None:
    s = scene("random", 60, WIDE)
    params, T, view = params_of(s), s.T_camera_world.numpy(), view_on("cpu", WIDE)
    weights = accumulate(view, params, T, torch.ones(3, WIDE.height, WIDE.width))
    alpha = view.alpha[: WIDE.height, : WIDE.width].sum()
    torch.testing.assert_close(weights[:, 0].sum(), alpha, rtol=1e-4, atol=0.0)
    assert torch.equal(render_values(view, params, T, torch.zeros(60, 3)), torch.zeros(3, WIDE.height, WIDE.width))
