"""fit_pose by alignment: what images are aligned to, how their pixels are weighed, and in whose world the pose is."""

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from paper_settings import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.fit.pose import fit_pose_align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference, keyframe_reference, map_reference
from sigmasplat.fit.target import Target, gray_of
from sigmasplat.plugins.sources import SyntheticRoom
from sigmasplat.render import render
from sigmasplat.render.backend import make_view
from sigmasplat.render.view import View
from splat_fields import OPTIONS
from splat_wall import CAMERA, TRUTH, assert_near, lower_median, seen_from, wall

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")


@pytest.fixture(params=["reference", "cpu"])
def view(request: pytest.FixtureRequest) -> View:
    return make_view(request.param, CAMERA, OPTIONS)


def pyramid(target: Target) -> Pyramid:
    return Pyramid.of(gray_of(target.image.numpy()), target.depth_image.numpy(), CAMERA)


def half_unsure() -> Tensor:
    """Make the right half of the wall's colours uncertain."""
    params = wall().clone()
    params[:, COLUMNS["log_variances"]] = torch.where(params[:, :1] > 0.1, -2.0, -8.0)
    return params


def test_a_keyframes_pixels_count_less_where_the_map_is_unsure(view: View) -> None:
    image = pyramid(seen_from(view, TRUTH))
    config = TrackingConfig(tau=2.0, weight_max=3.0)
    reference = keyframe_reference(half_unsure(), view, image, TRUTH, config)
    weight = reference.pyramid.weight[0]
    assert weight is not None and weight.shape == (CAMERA.height, CAMERA.width)
    opaque = view.alpha[: CAMERA.height, : CAMERA.width].numpy() > 0.95
    u = np.arange(CAMERA.width)[None].repeat(CAMERA.height, 0)
    sure, unsure = weight[opaque & (u < 12)], weight[opaque & (u > 28)]
    assert len(sure) > 100 and len(unsure) > 100
    assert np.median(unsure) < 0.5 * np.median(sure) and weight.min() >= 1 / 3 and weight.max() <= 3.0
    np.testing.assert_array_equal(weight[~opaque], 1.0)  # where the map is thin, V says nothing
    np.testing.assert_array_equal(reference.pyramid.gray[0], image.gray[0])
    np.testing.assert_array_equal(reference.pyramid.depth[0], image.depth[0])
    np.testing.assert_array_equal(reference.T_camera_world, TRUTH)


@pytest.mark.parametrize("kind", ["keyframe", "map"])
def test_a_reference_weighs_pixels_by_the_papers_weights(view: View, kind: str) -> None:
    image, config = pyramid(seen_from(view, TRUTH)), TrackingConfig(tau=3.0, weight_max=2.0)
    if kind == "keyframe":
        reference = keyframe_reference(wall(), view, image, TRUTH, config)
    else:
        reference = map_reference(wall(), view, TRUTH, config)
    h, w = CAMERA.height, CAMERA.width
    sums, opaque = view.sums[:, :h, :w].double(), view.alpha[:h, :w] > 0.95
    log = ((sums[4:] - sums[:3] ** 2).clamp(min=0) + 1e-6).log()
    medians = torch.stack([lower_median(channel[opaque]) for channel in log])
    expected = torch.exp((medians[:, None, None] - log) / 3.0).clamp(0.5, 2.0).mean(0)
    np.testing.assert_allclose(reference.pyramid.weight[0], torch.where(opaque, expected, 1.0), rtol=1e-3)


@pytest.mark.parametrize("kind", ["keyframe", "map"])
def test_depth_is_weighed_by_the_maps_depth_variance_where_asked(view: View, kind: str) -> None:
    """U = Σ w (z − D)² about the reference's own depth, in the form of w̃; gray keeps its weight."""
    image, config = pyramid(seen_from(view, TRUTH)), TrackingConfig(tau=3.0, weight_max=2.0, align_depth_by="U")
    thick = wall().clone()
    thick[::2, 2] += 0.05  # every second splat lies behind the others: light comes from two depths
    if kind == "keyframe":
        reference = keyframe_reference(thick, view, image, TRUTH, config)
    else:
        reference = map_reference(thick, view, TRUTH, config)
    field = GaussianField(thick.double())
    depth = torch.as_tensor(reference.pyramid.depth[0]).double()
    maps = render(field, CAMERA, TRUTH, depth, OPTIONS, "reference")
    assert maps.uncertainty is not None
    known = (maps.alpha > 0.95) & (maps.uncertainty > 0)
    log = (maps.uncertainty + 1e-6).log()
    expected = torch.exp((lower_median(log[known]) - log) / 3.0).clamp(0.5, 2.0)
    got = reference.pyramid.weight_depth[0]
    assert got is not None and known.sum() > 100 and float(log[known].std()) > 0.1
    np.testing.assert_allclose(got, torch.where(known, expected, 1.0), rtol=5e-3)
    by_V = dataclasses.replace(config, align_depth_by="V")
    plain = (
        keyframe_reference(thick, view, image, TRUTH, by_V)
        if kind == "keyframe"
        else map_reference(thick, view, TRUTH, by_V)
    )
    np.testing.assert_array_equal(reference.pyramid.weight[0], plain.pyramid.weight[0])
    assert plain.pyramid.weight_depth[0] is plain.pyramid.weight[0]


@pytest.mark.parametrize("kind", ["keyframe", "map"])
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_depth_is_weighed_by_u_where_the_system_has_no_colour_variance(backend: str, kind: str) -> None:
    """U needs no σ²: the weight of depth is the one a view with V finds, and gray has none."""
    config, found = TrackingConfig(tau=3.0, weight_max=2.0, align_depth_by="U"), []
    thick = wall().clone()
    thick[::2, 2] += 0.05
    for variance in (True, False):
        view = make_view(backend, CAMERA, OPTIONS, variance)
        image = pyramid(seen_from(view, TRUTH))
        if kind == "keyframe":
            found.append(keyframe_reference(thick, view, image, TRUTH, config).pyramid)
        else:
            found.append(map_reference(thick, view, TRUTH, config).pyramid)
    both, without = found
    assert both.weight[0] is not None and without.weight == [None] * len(without.cameras)
    assert both.weight_depth[0] is not None and without.weight_depth[0] is not None
    assert float(without.weight_depth[0].std()) > 0.1
    np.testing.assert_allclose(without.weight_depth[0], both.weight_depth[0], rtol=1e-5)
    off = dataclasses.replace(config, uncertainty=False)
    assert map_reference(thick, make_view(backend, CAMERA, OPTIONS, False), TRUTH, off).pyramid.weight_depth[0] is None


def test_without_uncertainty_a_keyframe_is_its_image_alone(view: View) -> None:
    image = pyramid(seen_from(view, TRUTH))
    config = TrackingConfig(uncertainty=False)
    assert keyframe_reference(wall(), view, image, TRUTH, config).pyramid is image
    assert map_reference(wall(), view, TRUTH, config).pyramid.weight[0] is None


def test_the_map_as_reference_is_surface_and_colour_undimmed(view: View) -> None:
    reference = map_reference(wall(), view, TRUTH, TrackingConfig())
    h, w = CAMERA.height, CAMERA.width
    sums, alpha = view.sums[:, :h, :w].numpy(), view.alpha[:h, :w].numpy()
    opaque = alpha > 0.95
    assert 100 < opaque.sum() < opaque.size
    np.testing.assert_allclose(reference.pyramid.depth[0], np.where(opaque, sums[3] / alpha, 0.0), rtol=1e-5)
    gray = 0.299 * sums[0] + 0.587 * sums[1] + 0.114 * sums[2]
    np.testing.assert_allclose(reference.pyramid.gray[0][opaque], (gray / alpha)[opaque], rtol=1e-5)


def test_aligning_gives_the_live_cameras_pose_in_the_references_world() -> None:
    room = SyntheticRoom(frames=200, width=160, height=120, exposure_change=False)
    T_camera_world = [se3.inverse(T) for T in room.truth().T_world_camera]
    images = [Pyramid.of(gray_of(f.color), f.depth_m, f.camera) for f in map(room.frame, (10, 12))]
    reference, config = Reference(images[0], T_camera_world[10]), TrackingConfig()
    for guess in (10, 11):
        fit = fit_pose_align(reference, images[1], T_camera_world[guess], config)
        assert_near(fit.T_camera_world, T_camera_world[12], 2e-3, 0.1)
        assert fit.agreement > 0.9 and fit.overlap > 0.7 and fit.covariance is not None
        assert np.isfinite(fit.covariance).all() and np.isnan(fit.first_loss)
