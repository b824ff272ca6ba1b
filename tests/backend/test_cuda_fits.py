"""Fit and track on the CUDA view, emulated: what stands above `render/` runs on it, to the CPU's result.

Emulated tensors all lie on the CPU; what no emulation sees is whether something mixes devices.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from emulated_cuda import Emulator
from paper_settings import MappingConfig, TrackingConfig
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.pose import fit_pose_adam
from sigmasplat.fit.target import Keyframe
from sigmasplat.plugins.cuda import view as cuda_view
from sigmasplat.plugins.cuda.view import CudaView
from sigmasplat.plugins.sources import SyntheticRoom
from sigmasplat.render.cpu import CpuView
from sigmasplat.system.slam import Slam
from splat_fields import OPTIONS, params_of
from splat_fits import target_of
from splat_scenes import assert_same_vector, scene

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

CPU = torch.device("cpu")
MAPPING = MappingConfig(weight_alignment=0.3, weight_moment=0.2, weight_isotropy_ratio=0.1)


@pytest.fixture(autouse=True)
def on_the_cpu(emulator: Emulator) -> Iterator[None]:
    with emulator.standing_in():
        emulator.order = 0
        yield


def fitted(view: Any, mapping: MappingConfig, images: int) -> tuple[GaussianField, list[float], np.ndarray]:
    s = scene("random", 60)
    field = GaussianField(params_of(s))
    target = target_of(s.camera, tuple(view.alpha.shape))
    pose = se3.inverse(s.T_camera_world.double().numpy())
    keyframes = [Keyframe(k, target, pose @ se3.exp(0.01 * k * np.ones(6))) for k in range(images)]
    fit = fit_field(field, view, [keyframes] * 3, mapping)
    return field, fit.losses, keyframes[-1].T_world_camera


@pytest.mark.parametrize("images", [1, 2])
def test_a_field_is_fitted_as_on_the_cpu(images: int) -> None:
    s = scene("random", 60)
    start = params_of(s)
    ours, losses, pose = fitted(CudaView(s.camera, OPTIONS, True, CPU), MAPPING, images)
    theirs, wanted, wanted_pose = fitted(CpuView(s.camera, OPTIONS), MAPPING, images)
    np.testing.assert_allclose(losses, wanted, rtol=1e-4)
    np.testing.assert_allclose(pose, wanted_pose, atol=1e-5)
    assert_same_vector(ours.params - start, theirs.params - start, 2e-2, "what Adam moved")


def test_a_pose_is_found_as_on_the_cpu() -> None:
    s = scene("random", 60)
    params, T = params_of(s), s.T_camera_world.double().numpy()
    found = []
    for view in (CudaView(s.camera, OPTIONS, True, CPU), CpuView(s.camera, OPTIONS)):
        target = target_of(s.camera, tuple(view.alpha.shape))
        found.append(fit_pose_adam(params, view, target, T, TrackingConfig(exposure=True), 5))
    np.testing.assert_allclose(found[0].T_camera_world, found[1].T_camera_world, atol=1e-5)
    np.testing.assert_allclose(found[0].loss, found[1].loss, rtol=1e-4)


def settings(**changes: str) -> Config:
    small = {"input.width": "48", "mapping.first_iterations": "5", "mapping.iterations": "2", "mapping.every": "2"}
    small |= {"final.iterations": "0", "seeding.first_uniform": "200", "seeding.first_gradient": "200"}
    return override(
        preset(default_preset()), small | {name.replace("__", "."): value for name, value in changes.items()}
    )


@pytest.mark.parametrize("method", ["align", "adam"])
def test_slam_runs_on_it(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    class Here(CudaView):
        def __init__(self, camera: Any, options: Any, variance: bool = True) -> None:
            super().__init__(camera, options, variance, CPU)

    monkeypatch.setattr(cuda_view, "CudaView", Here)
    room, paths = SyntheticRoom(frames=200, width=48, height=36), []
    for backend in ("cuda", "cpu"):
        slam = Slam(settings(backend=backend, tracking__method=method, tracking__iterations="3"))
        for i in range(3):
            slam.step(room.frame(i))
        slam.finish()
        paths.append(slam.trajectory().T_world_camera)
        assert len(slam.field) > 100 and torch.isfinite(slam.field.params).all()
    np.testing.assert_allclose(paths[0], paths[1], atol=5e-3)
    assert np.ptp(paths[0][:, :3, 3], axis=0).max() > 1e-3, "the camera moves"
