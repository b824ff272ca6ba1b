"""Weights by the predicted variance: the variance that they read, the residuals of splats, and what they change."""

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from sigmasplat.config import RenderConfig, TrackingConfig
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.data.map_uncertainty import SHIPPED, Background, MapUncertainty
from sigmasplat.errors import ConfigError
from sigmasplat.fit.gray import gray_of
from sigmasplat.fit.predicted_variance import residuals_at, use_predicted_variance, with_residuals
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import keyframe_reference, map_reference
from sigmasplat.fit.target import Target
from sigmasplat.render.backend import make_view
from sigmasplat.render.blended_values import blend_values
from sigmasplat.render.predictive import predict
from sigmasplat.render.view import View
from sigmasplat.tracking.tracker import Tracker
from splat_fields import OPTIONS
from splat_scenes import WIDE, scene
from splat_wall import CAMERA, TRUTH, seen_from, wall

BACKGROUND = Background((0.4, 0.5, 0.3), 0.05, 0.8)
PREDICTED = TrackingConfig(tau=2.0, weight_max=3.0, method="align", variance="predicted")


@pytest.fixture(params=["reference", "cpu"])
def view(request: pytest.FixtureRequest) -> View:
    if request.param == "cpu":
        pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built")
    return make_view(request.param, CAMERA, OPTIONS)


def random_field() -> tuple[GaussianField, np.ndarray]:
    """Return splats with random colours and σ², and a pose."""
    s, numbers = scene("random", 60, WIDE).to(torch.float32), torch.Generator().manual_seed(3)
    logits = (s.opacities / (1.0 - s.opacities)).log()[:, None]
    colors, log_variances = torch.rand(60, 3, generator=numbers), -5.0 + torch.rand(60, 3, generator=numbers)
    return GaussianField(torch.cat([s.means, s.quats, s.scales.log(), logits, colors, log_variances], 1)), (
        s.T_camera_world.double().numpy()
    )


def pyramid(target: Target) -> Pyramid:
    return Pyramid.of(gray_of(target.image.numpy()), target.depth_image.numpy(), CAMERA)


def repainted(target: Target) -> Target:
    """Return the target with other colours in its right half, so that the map contradicts it there."""
    color = target.color.clone()
    color[:, :, 24:] = (color[:, :, 24:] + 0.3).clamp(max=1.0) - 0.15
    return Target(target.camera, color, target.depth, target.valid_pixels)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_the_weights_read_the_variance_that_the_map_predicts(backend: str) -> None:
    field, T = random_field()
    residuals = torch.rand(60, generator=torch.Generator().manual_seed(4)) * 0.01
    view = make_view(backend, WIDE, RenderConfig())
    view.forward(with_residuals(field.params, residuals), T)
    use_predicted_variance(view, BACKGROUND)
    sums = view.sums[:, : WIDE.height, : WIDE.width]
    found = (sums[4:7] - sums[:3].square()).mean(0)
    splats = torch.stack([residuals, torch.zeros(60), torch.zeros(60)], 1)
    want = predict(field, MapUncertainty(splats, BACKGROUND, SHIPPED), WIDE, T, RenderConfig(), backend).color
    # The floor is part of the splats here, so an empty pixel has none.
    # The scale of a weight does not matter, so the temperature is left out.
    found = SHIPPED.temperature["color"] * found
    assert torch.allclose(found, want, rtol=1e-2, atol=2.0 * SHIPPED.color["floor"])
    assert float(want.max()) > 100.0 * SHIPPED.color["floor"]


def test_the_residual_of_a_splat_is_the_mean_squared_error_of_its_pixels(view: View) -> None:
    target = repainted(seen_from(view, TRUTH))
    found = residuals_at(wall(), view, target, TRUTH)
    seen = blend_values(GaussianField(wall()), CAMERA, TRUTH, wall()[:, :0], OPTIONS, "reference", gather=True)
    squared = (seen.color.clamp(0, 1) - target.image).square().mean(-1)
    errors, weights = seen.gather(torch.stack([squared, torch.ones_like(squared)], -1)).T
    assert torch.allclose(found, (errors + squared.mean()) / (weights + 1.0), rtol=1e-3)
    contradicted = wall()[:, 0] > 0.3
    assert float(found[contradicted].median()) > 2.0 * float(found[~contradicted].median())


def test_a_pixel_counts_less_where_the_keyframe_contradicts_the_map(view: View) -> None:
    target = repainted(seen_from(view, TRUTH))
    image, published = pyramid(target), dataclasses.replace(PREDICTED, variance="published")
    predicted = keyframe_reference(wall(), view, image, TRUTH, PREDICTED, target).weights
    by_V = keyframe_reference(wall(), view, image, TRUTH, published, target).weights
    alone = keyframe_reference(wall(), view, image, TRUTH, PREDICTED).weights
    assert predicted is not None and by_V is not None and alone is not None
    opaque = view.alpha[: CAMERA.height, : CAMERA.width].numpy() > 0.95
    u = np.arange(CAMERA.width)[None].repeat(CAMERA.height, 0)
    left, right = opaque & (u < 18), opaque & (u > 28)
    assert np.median(predicted[right]) < 0.5 * np.median(predicted[left])
    assert np.median(by_V[right]) == pytest.approx(np.median(by_V[left]), rel=0.3)
    np.testing.assert_array_equal(alone, by_V)  # without colours of the keyframe, V is used


def test_depth_has_its_own_predicted_variance_where_asked(view: View) -> None:
    target = seen_from(view, TRUTH)
    depth = target.depth_image.numpy().copy()
    depth[:, 24:] += np.where(depth[:, 24:] > 0, np.float32(0.3), np.float32(0.0))
    wrong = target.with_depth(depth)
    config = dataclasses.replace(PREDICTED, align_depth_by="U")
    found = keyframe_reference(wall(), view, pyramid(wrong), TRUTH, config, wrong).pyramid.weight_depth[0]
    assert found is not None
    opaque = view.alpha[: CAMERA.height, : CAMERA.width].numpy() > 0.95
    u = np.arange(CAMERA.width)[None].repeat(CAMERA.height, 0)
    assert np.median(found[opaque & (u > 28)]) < 0.5 * np.median(found[opaque & (u < 18)])


def test_a_rendered_reference_takes_the_background_of_its_submap(view: View) -> None:
    params = wall()
    residuals = torch.where(params[:, 0] > 0, 0.05, 1e-5)
    reference = map_reference(with_residuals(params, residuals), view, TRUTH, PREDICTED, BACKGROUND)
    weight, plain = reference.weights, map_reference(params, view, TRUTH, PREDICTED).weights
    assert weight is not None and plain is not None
    opaque = view.alpha[: CAMERA.height, : CAMERA.width].numpy() > 0.95
    u = np.arange(CAMERA.width)[None].repeat(CAMERA.height, 0)
    assert np.median(weight[opaque & (u > 28)]) < 0.5 * np.median(weight[opaque & (u < 12)])
    assert np.median(plain[opaque & (u > 28)]) == pytest.approx(np.median(plain[opaque & (u < 12)]), rel=0.3)


def test_residuals_leave_everything_else_of_a_splat_unchanged() -> None:
    params: Tensor = wall()
    rows = with_residuals(params, torch.full((len(params),), 0.01))
    column = COLUMNS["log_variances"]
    assert torch.equal(rows[:, : column.start], params[:, : column.start])
    assert bool((rows[:, column] > params[:, column]).all())


def test_descent_cannot_track_by_the_predicted_variance() -> None:
    with pytest.raises(ConfigError, match="needs tracking"):
        Tracker(TrackingConfig(method="adam", variance="predicted"))
    Tracker(TrackingConfig(method="adam", variance="predicted", uncertainty=False))
