"""References and live images of a CUDA view, emulated: the CPU's values, as tensors that no host waits for."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from emulated_cuda import Emulator
from paper_settings import TrackingConfig
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame, PosePrior
from sigmasplat.data.readout import SensorTimes
from sigmasplat.fit.pose import fit_pose_align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference, keyframe_reference, live_image, map_reference
from sigmasplat.graph.registration import Registrar
from sigmasplat.plugins.cuda.view import CudaView
from sigmasplat.render.cpu import CpuView
from sigmasplat.render.reference import ReferenceView
from sigmasplat.render.view import View
from sigmasplat.run_folder.state import read_state, write_state
from sigmasplat.tracking.moving import dynamic_detector
from sigmasplat.tracking.pose_prediction import CameraMotion
from sigmasplat.tracking.pose_validation import TrackingStatistics
from sigmasplat.tracking.predicted_depth_fit import DepthFit, DepthShape
from sigmasplat.tracking.prepared_frame import PreparedFrame
from sigmasplat.tracking.tracker import Tracker
from splat_fields import CPU, OPTIONS
from splat_fits import Watch
from splat_wall import CAMERA, TRUTH, seen_from, wall

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

CONFIGS = {
    "V": TrackingConfig(tau=3.0, weight_max=2.0),
    "U": TrackingConfig(tau=3.0, weight_max=2.0, align_depth_by="U"),
    "none": TrackingConfig(uncertainty=False),
}


@pytest.fixture(autouse=True)
def on_the_cpu(emulator: Emulator) -> Iterator[Emulator]:
    with emulator.standing_in():
        emulator.order = 0
        yield emulator


def views() -> tuple[CudaView, CpuView]:
    return CudaView(CAMERA, OPTIONS, True, CPU), CpuView(CAMERA, OPTIONS)


def thick() -> torch.Tensor:
    params = wall().clone()
    params[::2, 2] += 0.05  # light comes from two depths
    return params


def live(view: View) -> Pyramid:
    target = seen_from(view, TRUTH)
    return live_image(view, target.image.numpy(), target.depth_image.numpy(), target)


def reference(kind: str, view: View, config: TrackingConfig) -> Reference:
    if kind == "map":
        return map_reference(thick(), view, TRUTH, config)
    return keyframe_reference(thick(), view, live(view), TRUTH, config)


def assert_same_pyramid(got: Pyramid, want: Pyramid, atol: float) -> None:
    assert got.backend == "cuda" and got.cameras == want.cameras
    for name in ("gray", "depth", "weight", "weight_depth"):
        for ours, theirs in zip(getattr(got, name), getattr(want, name), strict=True):
            assert (ours is None) == (theirs is None)
            if ours is not None:
                assert isinstance(ours, torch.Tensor) and ours.dtype == torch.float32
                np.testing.assert_allclose(ours, theirs, atol=atol)


def test_a_live_image_is_the_cpus() -> None:
    cuda, cpu = views()
    target = seen_from(cpu, TRUTH)
    image, depth_m = target.image.numpy(), target.depth_image.numpy()
    there = dataclasses.replace(target, color=target.color[:, : CAMERA.height, : CAMERA.width].contiguous())
    there.depth = target.depth_image.contiguous()
    assert_same_pyramid(live_image(cuda, image, depth_m, there), live_image(cpu, image, depth_m, target), 2e-7)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
@pytest.mark.parametrize("kind", ["map", "keyframe"])
def test_references_are_the_cpus(kind: str, config: TrackingConfig) -> None:
    got, want = (reference(kind, view, config).pyramid for view in views())
    assert_same_pyramid(got, want, 2e-4)
    assert (want.weight[0] is None) == (not config.uncertainty)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
@pytest.mark.parametrize("kind", ["map", "keyframe"])
def test_the_host_waits_for_no_plane_of_a_reference(kind: str, config: TrackingConfig) -> None:
    view, _ = views()
    params, image = thick(), live(view)
    view.forward(params, TRUTH)  # says how many pairs to expect
    with Watch() as watch:
        if kind == "map":
            map_reference(params, view, TRUTH, config)
        else:
            keyframe_reference(params, view, image, TRUTH, config)
    assert watch.reads == 0


def test_a_pose_is_aligned_to_the_map_as_on_the_cpu() -> None:
    guess = se3.exp(np.array([0.01, -0.01, 0.01, 0.004, -0.003, 0.002])) @ TRUTH
    found = [
        fit_pose_align(map_reference(thick(), view, guess, CONFIGS["V"]), live(view), guess, CONFIGS["V"])
        for view in views()
    ]
    np.testing.assert_allclose(found[0].T_camera_world, found[1].T_camera_world, atol=1e-4)
    assert found[0].agreement == pytest.approx(found[1].agreement, abs=1e-2) and found[0].overlap > 0.3
    assert found[0].covariance is not None and np.isfinite(found[0].covariance).all()


def test_a_keyframe_is_aligned_to_a_submap_as_on_the_cpu() -> None:
    """Registration's localisation, which needs no CPU's planes.

    On so small an image a pixel more or less within the gates moves a pose by a tenth of a millimetre and its
    deviation by a sixth, so deviations are compared at one pose.
    """
    from sigmasplat.data.submap import MemoryStore

    found = []
    for view in views():
        registrar = Registrar(preset(default_preset()), MemoryStore(), view)
        fit = registrar._aligned(thick(), live(view), TRUTH)
        found.append((fit, *registrar._checked(thick(), live(view), TRUTH)))
    assert all(fit.alignment is not None for fit, *_ in found)
    np.testing.assert_allclose(found[0][0].T_camera_world, found[1][0].T_camera_world, atol=5e-4)
    deviations = [np.sqrt(np.diag(covariance)) for _, covariance, _ in found]
    np.testing.assert_allclose(*deviations, rtol=0.1)
    compared = [dataclasses.astuple(comparison) for *_, comparison in found if comparison is not None]
    np.testing.assert_allclose(*compared, rtol=0.1, atol=0.02)


def test_what_a_tracker_remembers_is_kept_and_read_back(tmp_path: Path) -> None:
    view, _ = views()
    kept = reference("keyframe", view, CONFIGS["V"])
    tracker, classes = (
        Tracker(CONFIGS["V"], keyframe=kept),
        (
            Tracker,
            CameraMotion,
            SensorTimes,
            PosePrior,
            Reference,
            Pyramid,
            Camera,
            TrackingStatistics,
            dynamic_detector.DynamicDetector,
            DepthFit,
            DepthShape,
        ),
    )
    target = seen_from(view, TRUTH)
    frame = Frame(0, 0.0, target.image.numpy(), target.depth_image.numpy(), CAMERA)
    tracker.start(PreparedFrame(target, kept.pyramid, frame=frame, whole=frame))
    fixed = {"tracking": CONFIGS["V"], "moving": tracker.detector.config}
    write_state(tmp_path / "state", tracker, classes, fixed)
    again = read_state(tmp_path / "state", classes, fixed)
    assert again.keyframe.pyramid.backend == "cuda"
    for ours, theirs in zip(again.keyframe.pyramid.weight, kept.pyramid.weight, strict=True):
        assert torch.equal(ours, theirs)
    np.testing.assert_array_equal(again.last_image.gray[0], kept.pyramid.gray[0])


def test_only_the_definition_keeps_its_images_as_arrays() -> None:
    view = ReferenceView(CAMERA, OPTIONS)
    for image in (live(view), map_reference(thick(), view, TRUTH, CONFIGS["U"]).pyramid):
        assert all(isinstance(plane, np.ndarray) for plane in (*image.gray, *image.depth))
