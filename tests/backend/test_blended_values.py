"""Values of splats in an image, and sums over the pixels of a splat, on every backend against the definition."""

import pytest
import torch
from torch import Tensor

from paper_settings import RenderConfig
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.render.backend import gather, make_view, on_device
from sigmasplat.uncertainty.predictive import BlendedValues, blend_values
from splat_fields import params_of
from splat_scenes import KINDS, WIDE, Scene, assert_same_vector, scene

OPTIONS = RenderConfig()


def numbers(*size: int, seed: int = 0) -> Tensor:
    """Draw numbers ≥ 0."""
    return torch.rand(*size, generator=torch.Generator().manual_seed(seed))


def blended(s: Scene, params: Tensor, values: Tensor, backend: str) -> BlendedValues:
    field = on_device(GaussianField(params), backend)
    return blend_values(field, WIDE, s.T_camera_world.numpy(), values, OPTIONS, backend, gather=True)


@pytest.mark.parametrize("count", [0, 3, 12])
@pytest.mark.parametrize("kind", KINDS)
def test_sums_and_values_agree_with_the_definition(kernels: str, kind: str, count: int) -> None:
    s = scene(kind, 60, WIDE)
    params, planes, values = params_of(s), numbers(WIDE.height, WIDE.width, 3), numbers(60, count, seed=1)
    exact, found = (blended(s, p, v, b) for p, v, b in (
        (params.double(), values.double(), "reference"), (params, values, kernels),
    ))  # fmt: skip
    for plane in ("values", "alpha", "depth"):
        if getattr(exact, plane).numel():
            assert_same_vector(getattr(found, plane), getattr(exact, plane), what=f"{plane} of {kind}")
    want = exact.gather(planes)
    assert float(want.min()) >= 0.0 and float(want.max()) > 0.0
    assert_same_vector(found.gather(planes), want, what=f"sums of {kind}")


def test_a_sum_is_the_transpose_of_a_render(kernels: str) -> None:
    s = scene("random", 60, WIDE)
    values, g = numbers(60, 3, seed=1), numbers(WIDE.height, WIDE.width, 3)
    seen = blended(s, params_of(s), values, kernels)
    over_pixels = (g * seen.values.cpu()).sum((0, 1))
    over_splats = (values * seen.gather(g).cpu()).sum(0)
    torch.testing.assert_close(over_pixels, over_splats, rtol=1e-4, atol=0.0)


def test_sums_do_not_depend_on_the_values_of_the_splats() -> None:
    s, planes = scene("random", 60, WIDE), numbers(WIDE.height, WIDE.width, 2)
    params = params_of(s)
    first = blended(s, params, numbers(60, 2), "cpu").gather(planes)
    changed = params.clone()
    changed[:, COLUMNS["log_variances"]] += 3.0
    assert torch.equal(blended(s, changed, numbers(60, 2, seed=5), "cpu").gather(planes), first)


@pytest.mark.parametrize("depth", ["center", "ray"])
def test_a_view_sums_pixels_over_splats_as_a_blend_does(kernels: str, depth: str) -> None:
    s, planes = scene("random", 60, WIDE), numbers(3, WIDE.height, WIDE.width)
    params, view = params_of(s), make_view(kernels, WIDE, RenderConfig(depth=depth))
    params = params.to(view.sums.device)
    view.forward(params, s.T_camera_world.numpy())
    want = blended(s, params_of(s).double(), numbers(60, 0), "reference").gather(planes.movedim(0, -1))
    assert_same_vector(gather(view, params, planes.to(params)), want, what="sums of a view")


def test_ones_sum_to_the_weights_of_the_splats(kernels: str) -> None:
    s = scene("random", 60, WIDE)
    seen = blended(s, params_of(s), torch.zeros(60, 3), kernels)
    weights = seen.gather(torch.ones(WIDE.height, WIDE.width, 1))
    torch.testing.assert_close(weights.sum(), seen.alpha.sum(), rtol=1e-4, atol=0.0)
    assert float(seen.values.abs().max()) == 0.0
