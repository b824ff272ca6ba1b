"""On a CUDA device: the view and the fused step held to the definition, the same bytes twice, five million splats.

Skipped without a device. For memory errors run this file under compute-sanitizer.
"""

import numpy as np
import pytest
import torch
from torch import Tensor

from sigmasplat.fit.cuda_step import CudaStep
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import COLUMNS, GaussianField
from sigmasplat.render import cuda_launch, render
from sigmasplat.render.cuda_view import CudaView
from splat_fields import OPTIONS, crowd, exact_view, params_of, there_and_back
from splat_scenes import KINDS, assert_same_vector, scene
from test_compiled_loss import RATES, WEIGHTS, target_of

REASON = cuda_launch.missing()
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))


def on_device(params: Tensor, camera: Camera, T: np.ndarray, variance: bool = True) -> list[Tensor]:
    return [x.cpu() for x in there_and_back(CudaView(camera, OPTIONS, variance), params.cuda(), T)]


@pytest.mark.parametrize("variance", [False, True], ids=["K4", "K7"])
@pytest.mark.parametrize("kind", KINDS)
def test_planes_rows_and_twist_agree(kind: str, variance: bool) -> None:
    s = scene(kind, 60)
    params, T = params_of(s), s.T_camera_world.numpy()
    maps, rows, twist = on_device(params, s.camera, T, variance)
    want_maps, want_rows, want_twist = there_and_back(exact_view(s.camera, variance), params.double(), T)
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
    target = target_of(s.camera, (s.camera.height, s.camera.width)).on(field.params.device)
    step, before, losses = CudaStep(view), field.params.clone(), []
    for field.steps in range(1, 21):
        step.forward(field, s.T_camera_world.numpy(), target, WEIGHTS)
        losses.append(float(step.images(target, WEIGHTS)))
        step.splats(field, RATES, WEIGHTS, 0)
    assert losses[-1] < losses[0] and torch.isfinite(field.params).all() and not torch.equal(field.params, before)


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
