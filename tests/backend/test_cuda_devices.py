"""Run views, fits, tracking and SLAM on a pretended CUDA device, where mixing devices is refused as on a real one."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from emulated_cuda import Emulator
from pretended_device import DEVICE, NAME, pretended
from sigmasplat import cli
from sigmasplat.config import MappingConfig, TrackingConfig
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.pose import fit_pose_adam
from sigmasplat.fit.target import Keyframe
from sigmasplat.model import se3
from sigmasplat.model.field import GaussianField
from sigmasplat.render import render
from sigmasplat.render.cuda_view import CudaView
from sigmasplat.slam.slam import Slam
from sigmasplat.sources import SyntheticRoom
from splat_fields import OPTIONS, params_of, there_and_back
from splat_scenes import scene
from test_compiled_loss import target_of
from test_cuda_fits import settings


@pytest.fixture(autouse=True)
def device(emulator: Emulator) -> Iterator[torch.device]:
    with pretended(emulator) as there:
        emulator.order = 0
        yield there


def test_it_behaves_as_a_device() -> None:
    x = torch.arange(6.0).to(DEVICE)
    assert x.device == DEVICE and (x + 1)[::2].device == DEVICE and float(x.sum()) == 15.0
    assert torch.zeros(3, device=NAME).device == DEVICE and x.cpu().device.type == "cpu"
    x[1:3] = torch.tensor([5.0, 7.0])
    assert x.cpu().tolist() == [0, 5, 7, 3, 4, 5]
    with torch.inference_mode():
        assert torch.zeros(2).to(x).device == DEVICE and x.to("cpu").device.type == "cpu"
    with pytest.raises(RuntimeError, match="same device"):
        x + torch.arange(6.0)
    with pytest.raises(RuntimeError, match="indices should be"):
        torch.arange(6.0)[x.long()]
    with pytest.raises((TypeError, RuntimeError), match="numpy"):
        x.numpy()


def test_a_view_goes_there_and_back() -> None:
    s = scene("random", 60)
    T = s.T_camera_world.numpy()
    maps, rows, twist = there_and_back(CudaView(s.camera, OPTIONS), params_of(s).to(DEVICE), T)
    assert maps.device == rows.device == DEVICE and torch.isfinite(rows).all() and torch.isfinite(twist).all()


@pytest.mark.parametrize("pose_at", ["cpu", NAME])
@pytest.mark.parametrize("at", ["cpu", NAME])
def test_a_render_takes_field_and_pose_from_either_side(at: str, pose_at: str) -> None:
    s = scene("random", 60)
    params = params_of(s).to(at).requires_grad_()
    T, reference = s.T_camera_world.clone().to(pose_at).requires_grad_(), s.ref_depth.float()
    seen = render(GaussianField(params), s.camera, T, reference, OPTIONS, backend="cuda")
    assert seen.uncertainty is not None
    loss = seen.color.sum() + seen.variance.sum() + seen.uncertainty.sum() + seen.median_depth.sum()
    on_params, on_pose = torch.autograd.grad(loss, [params, T])
    assert (seen.color.device, on_params.device.type, on_pose.device.type) == (DEVICE, at, pose_at)
    assert torch.isfinite(on_params).all() and torch.isfinite(on_pose).all()


@pytest.mark.parametrize("images", [1, 2])
@pytest.mark.parametrize("at", ["cpu", NAME])
def test_a_field_is_fitted_from_either_side(at: str, images: int) -> None:
    s = scene("random", 60)
    field, view = GaussianField(params_of(s)), CudaView(s.camera, OPTIONS)
    field = field.on(DEVICE) if at == NAME else field
    target = target_of(s.camera, (s.camera.height, s.camera.width))
    pose = se3.inverse(s.T_camera_world.double().numpy())
    keyframes = [Keyframe(k, target, pose) for k in range(images)]
    pulls = list[torch.Tensor]()
    fit = fit_field(
        field, view, [keyframes] * 2, MappingConfig(weight_alignment=0.3, weight_moment=0.2),
        felt=lambda keyframe, pull: pulls.append(pull),
    )  # fmt: skip
    assert np.isfinite(fit.losses).all() and field.params.device.type == at == pulls[0].device.type


def test_a_pose_is_found() -> None:
    s = scene("random", 60)
    target = target_of(s.camera, (s.camera.height, s.camera.width))
    T = s.T_camera_world.double().numpy()
    for params in (params_of(s), params_of(s).to(DEVICE)):
        found = fit_pose_adam(params, CudaView(s.camera, OPTIONS), target, T, TrackingConfig(exposure=True), 3)
        assert np.isfinite(found.T_camera_world).all()


@pytest.mark.parametrize("method", ["align", "adam"])
def test_slam_runs_on_it(method: str) -> None:
    room = SyntheticRoom(frames=200, width=48, height=36)
    slam = Slam(settings(backend="cuda", tracking__method=method, tracking__iterations="3", final__iterations="2"))
    for i in range(3):
        slam.step(room.frame(i))
    slam.finish()
    assert len(slam.field) > 100 and torch.isfinite(slam.field.params).all()


def test_a_run_is_written_and_evaluated(tmp_path: Path) -> None:
    changes = {"backend": "cuda", "input.width": "48", "mapping.first_iterations": "4", "mapping.iterations": "2"}
    changes |= {"seeding.first_uniform": "200", "seeding.first_gradient": "200", "final.iterations": "2"}
    words = [word for name, value in changes.items() for word in ("--set", f"{name}={value}")]
    out = tmp_path / "run"
    with pytest.raises(SystemExit, match="0"):
        cli.main(["run", "synthetic:frames=6,width=48,height=36", "--out", str(out), *words])
    assert {"metrics.json", "map.ply", "checkpoint.safetensors"} <= {path.name for path in out.iterdir()}
