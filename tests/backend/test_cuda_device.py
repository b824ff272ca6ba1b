"""On a CUDA device: views, fused steps and tracking held to the definition, the same bytes twice, five million splats.

Skipped without a device. For memory errors run this file under compute-sanitizer.
"""

import dataclasses
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from constants import changed
from paper_settings import MappingConfig, RenderConfig, TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.fit.backends import step_for
from sigmasplat.fit.descent import Descent, descend
from sigmasplat.fit.tracking_loss import tracking_gradient
from sigmasplat.plugins.cuda import launch as cuda_launch
from sigmasplat.plugins.cuda.descent import CudaTrackingLoss, descend_on_device
from sigmasplat.plugins.cuda.mapping_step import CudaAccumulator, CudaStep
from sigmasplat.plugins.cuda.view import CudaView
from sigmasplat.render import render
from sigmasplat.render.backend import make_view
from sigmasplat.render.cpu import CpuView
from splat_fields import OPTIONS, crowd, exact_view, params_of, there_and_back
from splat_fits import RATES, WEIGHTS, target_of
from splat_scenes import KINDS, WIDE, assert_same_vector, scene
from splat_wall import CAMERA, TRUTH, seen_from, wall
from test_cuda_options import fitted

REASON = cuda_launch.missing()
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))


RAY = RenderConfig(depth="ray")


def on_device(
    params: Tensor, camera: Camera, T: np.ndarray, variance: bool = True, options: Any = OPTIONS
) -> list[Tensor]:
    return [x.cpu() for x in there_and_back(CudaView(camera, options, variance), params.cuda(), T)]


@pytest.mark.parametrize("options", [OPTIONS, RAY], ids=["center", "ray"])
@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
@pytest.mark.parametrize("kind", KINDS)
def test_planes_rows_and_twist_agree(kind: str, variance: bool, options: RenderConfig) -> None:
    s = scene(kind, 60)
    params, T = params_of(s), s.T_camera_world.numpy()
    maps, rows, twist = on_device(params, s.camera, T, variance, options)
    want_maps, want_rows, want_twist = there_and_back(exact_view(s.camera, variance, options), params.double(), T)
    assert float((maps - want_maps).norm()) < 2e-5 * float(want_maps.norm())
    for name, columns in COLUMNS.items():
        if variance or name != "log_variances":
            assert_same_vector(rows[:, columns], want_rows[:, columns], what=name)
    assert_same_vector(twist, want_twist, what="twist")


def test_two_runs_give_identical_bytes() -> None:
    s = crowd()
    first, second = (on_device(params_of(s), s.camera, s.T_camera_world.numpy()) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_render_goes_where_the_tensors_are() -> None:
    s = scene("random", 60)
    T = s.T_camera_world.float()
    there = render(GaussianField(params_of(s).cuda()), s.camera, T.cuda(), s.ref_depth.float().cuda())
    here = render(GaussianField(params_of(s)), s.camera, T, s.ref_depth.float(), backend="reference")
    assert there.color.device.type == "cuda"
    torch.testing.assert_close(there.color.cpu(), here.color, rtol=1e-4, atol=1e-4)
    assert there.uncertainty is not None and here.uncertainty is not None
    torch.testing.assert_close(there.uncertainty.cpu(), here.uncertainty, rtol=1e-4, atol=1e-4)


def test_a_step_is_taken() -> None:
    s = crowd()
    field, view = GaussianField(params_of(s).cuda()), CudaView(s.camera, OPTIONS)
    target = target_of(s.camera, (s.camera.height, s.camera.width)).to(field.params.device)
    step, before, losses = CudaStep(view), field.params.clone(), []
    for field.steps in range(1, 21):
        step.forward(field, s.T_camera_world.numpy(), target, WEIGHTS)
        losses.append(float(step.images(target, WEIGHTS)))
        step.splats(field, RATES, WEIGHTS, 0)
    assert losses[-1] < losses[0] and torch.isfinite(field.params).all() and not torch.equal(field.params, before)


OF_FITS = [(1, 0), (3, 0), (1, 3)]
"""Keyframes a step, degree of view-dependent colour."""


@pytest.mark.parametrize(("images", "degree"), OF_FITS)
def test_fits_are_those_of_the_cpu(images: int, degree: int) -> None:
    config = MappingConfig(weight_nll_color=1e-2)
    start = params_of(scene("random", 60))
    ours, losses, _ = fitted(CudaView(WIDE, OPTIONS), config, images, degree)
    theirs, wanted, _ = fitted(CpuView(WIDE, OPTIONS), config, images, degree)
    np.testing.assert_allclose(losses, wanted, rtol=1e-3)
    assert_same_vector(ours.params.cpu() - start, theirs.params - start, 3e-2, "what Adam moved")


@pytest.mark.parametrize(("images", "degree"), OF_FITS)
def test_torch_waits_for_no_part_of_an_iteration(images: int, degree: int) -> None:
    s, device = crowd(), cuda_launch.this_device()
    field, view = GaussianField(params_of(s)).copy_to(device), CudaView(s.camera, OPTIONS)
    target = target_of(s.camera, (s.camera.height, s.camera.width)).to(device)
    weights = {**WEIGHTS, "median_depth": 0.3}
    step, T = step_for(view, weights, degree), s.T_camera_world.numpy()
    for watched in (False, True):  # the first one compiles, makes room, and counts pairs
        torch.cuda.set_sync_debug_mode("error" if watched else "default")
        try:
            gathered, field.steps = CudaAccumulator(view, field), field.steps + 1
            for _ in range(images):
                step.forward(field, T, target, weights)
                step.images(target, weights)
                if images > 1:
                    gathered.add(field, 1.0 / images)
                else:
                    step.splats(field, RATES, weights, 3)
            if images > 1:
                gathered.step(field, RATES, weights, 3)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    assert torch.isfinite(field.params).all()


TRACKING = TrackingConfig(
    lr_rotation=4e-4, lr_translation=1e-3, tau=2.0, exposure=True, outlier_factor=5.0, outlier_factor_color=5.0,
    average="kept",
)  # fmt: skip
OFF = np.array([0.012, -0.015, 0.01, 0.012, -0.008, 0.015])


def followed(config: TrackingConfig, iterations: int, room: int | None = None, way: Any = descend_on_device) -> Descent:
    """Descend from beside the place that a wall was seen from."""
    view = CudaView(CAMERA, OPTIONS)
    params, target = wall().cuda(), seen_from(make_view("reference", CAMERA, OPTIONS), TRUTH).to(view.alpha.device)
    view.raster.capacity = room
    found: Descent = way(params, view, target, se3.exp(OFF) @ TRUTH, config, iterations)
    return found


@pytest.mark.parametrize("room", [None, 7], ids=["room", "too little"])
@pytest.mark.parametrize("parametrisation", ["quaternion", "axis-angle"])
def test_a_pose_is_found_without_the_host(parametrisation: Any, room: int | None) -> None:
    """As the Python loop finds it; captured, whose failure would be a warning, and not: the same bytes."""
    config = changed(TRACKING, parametrisation=parametrisation)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        captured = [followed(config, 20, room) for _ in range(3)]
    plain = followed(changed(config, cuda_graphs=False), 20, room)
    for found in captured:
        assert found[1:] == plain[1:]
        np.testing.assert_array_equal(found.T_camera_world, plain.T_camera_world)
    loop = followed(config, 20, way=descend)
    np.testing.assert_allclose(plain.T_camera_world, loop.T_camera_world, atol=1e-5)
    assert plain.loss == pytest.approx(loop.loss, rel=1e-3) and plain.steps == loop.steps == 20
    assert plain.loss < 0.6 * plain.first_loss


def test_a_descent_stops_where_the_loop_stops() -> None:
    crawling = dataclasses.replace(TRACKING, lr_rotation=1e-9, lr_translation=1e-9, exposure=False)
    assert followed(changed(crawling, plateau_stop=1e-3, plateau_window=5), 100).steps == 6


@pytest.mark.parametrize("average", ["image", "kept"])
def test_the_tracking_loss_is_as_defined(average: Any) -> None:
    s, config, exposure = crowd(), changed(TRACKING, average=average), torch.tensor([0.12, -0.03])
    view = CudaView(s.camera, OPTIONS)
    target = target_of(s.camera, (s.camera.height, s.camera.width)).to(view.alpha.device)
    view.forward(params_of(s).cuda(), s.T_camera_world.numpy())
    got = CudaTrackingLoss(view, target, config, torch.stack([exposure[0].exp(), exposure[1]]).cuda()).launch().sum(0)
    planes = view.g_sums.cpu()
    want, want_exposure = tracking_gradient(view, target, config, exposure.cuda())
    assert float(got[0]) == pytest.approx(want, rel=1e-4)
    assert_same_vector(planes, view.g_sums.cpu(), 1e-4, "planes")
    assert_same_vector(got[1:].cpu(), want_exposure.cpu(), 1e-4, "exposure")


@pytest.mark.parametrize("n", [0, 5_000_000])
def test_very_many_splats_and_none(n: int) -> None:
    camera, random = Camera(1920, 1080, 1000.0, 1000.0, 959.5, 539.5), torch.Generator("cuda").manual_seed(0)
    spread = torch.rand(n, 3, generator=random, device="cuda")
    means = (spread - 0.5) * torch.tensor([8.0, 5.0, 3.0], device="cuda") + torch.tensor([0.0, 0.0, 3.0], device="cuda")
    field = GaussianField.from_values(means, torch.full((n,), 0.005, device="cuda"), spread)
    view = CudaView(camera, OPTIONS)
    maps, rows, twist = there_and_back(view, field.params, np.eye(4))
    assert all(torch.isfinite(x).all() for x in (maps, rows, twist))
    assert (float(view.alpha.max()) > 0.5) == (n > 0) == bool(view.visible(n).any()) == bool(rows.any())
