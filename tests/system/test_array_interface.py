"""SLAM on arrays of your own camera: the same bytes as a recorded run, covariances, functions called at events."""

import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from paper_settings import InputConfig
from recorded_room import write_images
from schedules import AtOnce, Drawn
from sigmasplat import Camera, Slam, open_source
from sigmasplat.config import Config, RealTimeConfig
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.realtime.system import RealTime
from sigmasplat.system.array_interface import Correction
from small_room import SMALL, frame_at, frames

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

FRAMES = 12
K = (128.0, 128.0, 79.5, 59.5)
SETTINGS = SMALL | {
    "input.width": "96",
    "mapping.first_iterations": "20",
    "mapping.iterations": "8",
    "final.iterations": "6",
}
CUTS = SETTINGS | {"submaps.frames": "5"}


def images(i: int) -> tuple[np.ndarray, np.ndarray]:
    """Return colour as bytes and depth in millimetres, as a camera gives them."""
    frame = frame_at(i)
    return np.rint(255 * frame.color).astype(np.uint8), np.rint(1000 * frame.depth_m).astype(np.uint16)


def followed(settings: dict[str, Any] = SETTINGS, count: int = FRAMES, slam: Slam | None = None) -> Slam:
    slam = slam or Slam(settings=settings)
    for i in range(count):
        rgb, depth = images(i)
        slam.track(rgb, depth, K, i / 30, depth_scale=1000)
    return slam


def contents(slam: Slam) -> dict[str, bytes]:
    """Return every byte of what a run leaves: splats, optimiser, path, keyframes, tracking numbers."""
    tensors = {name: tensor.numpy().tobytes() for name, tensor in slam.checkpoint().items()}
    tracking = repr([(step.index, step.state, step.p_off, step.tracking) for step in slam.steps]).encode()
    return tensors | {"tracking": tracking, "field": slam.field.params.numpy().tobytes()}


@pytest.fixture(scope="module")
def run() -> Slam:
    slam = followed()
    slam.finish()
    return slam


def test_arrays_give_the_same_bytes_as_the_recording_of_them(run: Slam, tmp_path: Path) -> None:
    folder = write_images(tmp_path / "room", frames(FRAMES))
    source = open_source(folder, InputConfig(fx=128.0, cx=79.5, cy=59.5, depth_scale=1000.0))
    recorded = Slam(override(preset(default_preset()), SETTINGS))
    for frame in source:
        recorded.step(frame)
    recorded.finish()
    ours, theirs = contents(run), contents(recorded)
    assert [step.timestamp_s for step in run.steps] == [step.timestamp_s for step in recorded.steps]
    assert {name for name in ours if ours[name] != theirs[name]} == set()

    again = Slam(settings=SETTINGS)
    for i in range(FRAMES):
        bgr = cv2.imread(str(sorted((folder / "color").iterdir())[i]))
        depth = cv2.imread(str(sorted((folder / "depth").iterdir())[i]), cv2.IMREAD_UNCHANGED)
        again.track(bgr, depth, np.array([[128, 0, 79.5], [0, 128, 59.5], [0, 0, 1]]), i / 30,
                    depth_scale=1000, color_order="bgr")  # fmt: skip
    again.finish()
    assert contents(again) == ours


def test_torch_tensors_and_reused_buffers_give_the_same_bytes(run: Slam) -> None:
    slam = Slam(settings=SETTINGS)
    rgb, depth = torch.empty(120, 160, 3, dtype=torch.uint8), torch.empty(120, 160, dtype=torch.float64)
    for i in range(FRAMES):
        color, millimetres = images(i)
        rgb[:], depth[:] = torch.from_numpy(color), torch.from_numpy(millimetres / 1000)
        slam.track(rgb, depth.requires_grad_(), torch.tensor(K), torch.tensor(i / 30, dtype=torch.float64))
        depth = depth.detach()
        assert torch.equal(rgb, torch.from_numpy(color)) and torch.equal(depth, torch.from_numpy(millimetres / 1000))
        rgb[:], depth[:] = 3, 99.0  # a driver writes the next image into the same memory
    slam.finish()
    assert contents(slam) == contents(run)


def test_the_callers_arrays_stay_writeable_and_unchanged() -> None:
    slam, (rgb, depth) = Slam(settings=SETTINGS), images(0)
    arrays = rgb, depth, (rgb / 255).astype(np.float32), (depth / 1000).astype(np.float32)
    before = [array.tobytes() for array in arrays]
    slam.track(arrays[0], arrays[1], K, 0.0, depth_scale=1000)
    slam.track(arrays[2], arrays[3], K, 0.1)
    assert all(array.flags.writeable for array in arrays) and [array.tobytes() for array in arrays] == before


def test_slam_takes_a_preset_by_name_and_settings_of_any_type() -> None:
    slam = Slam(
        "cgslam-fast", settings={"input.width": 96, "mapping.overlap_below": 0.5, "tracking.verify": True, "seed": 7}
    )
    config = slam.config
    assert (config.name, config.input.width, config.mapping.overlap_below, config.tracking.verify, config.seed) == (
        "cgslam-fast", 96, 0.5, True, 7,
    )  # fmt: skip
    assert Slam().config == Slam("sigma").config == Slam(preset("sigma")).config
    assert Slam(preset("sigma"), settings={"seed": 3}).config.seed == 3
    for wrong, message in [
        ("sigmoid", "no preset 'sigmoid'"),
        (Config, "settings are type; give a Config or the name"),
    ]:
        with pytest.raises(ConfigError, match=message):
            Slam(wrong)
    for settings, message in [({"input.widht": 9}, "unknown setting .*width"), ({"input.width": 9.5}, "whole number")]:
        with pytest.raises(ConfigError, match=message):
            Slam("sigma", settings=settings)


def test_what_is_refused_leaves_the_state_as_it_was(run: Slam) -> None:
    slam, (rgb, depth) = Slam(settings=SETTINGS), images(0)
    with pytest.raises(SourceError, match="no pose yet"):
        slam.covariance()
    with pytest.raises(SourceError, match="has no depth reading"):
        slam.track(rgb, np.zeros_like(depth), K, -1.0, depth_scale=1000)
    for i in range(FRAMES):
        color, millimetres = images(i)
        slam.track(color, millimetres, K, i / 30, depth_scale=1000)
        before = len(slam.steps)
        for message, arguments in (
            (r"timestamp .* s repeats that of the frame before", (color, millimetres, K, i / 30)),
            (r"timestamp .* s is before that of the frame before \(.* s\)", (color, millimetres, K, i / 30 - 1e-3)),
            ("colour is from", (color.astype(np.float32), millimetres, K, 100.0)),
            ("depth is None", (color, None, K, 100.0)),
            ("comes from another camera", (color, millimetres, (129.0, 128.0, 79.5, 59.5), 100.0)),
        ):
            with pytest.raises(SourceError, match=message):
                slam.track(*arguments, depth_scale=1000)  # type: ignore[arg-type]
        assert len(slam.steps) == before
    slam.finish()
    assert contents(slam) == contents(run)


def test_a_camera_is_accepted_and_times_follow_those_of_frames() -> None:
    slam, frame = Slam(settings=SETTINGS), frame_at(0)
    slam.step(frame)
    camera = Camera(160, 120, *K)
    step = slam.track(frame.color, frame.depth_m, camera, frame.timestamp_s + 0.1)
    assert (step.index, step.state) == (1, "tracked")
    with pytest.raises(SourceError, match="repeats"):
        slam.track(frame.color, frame.depth_m, camera, frame.timestamp_s + 0.1)


# ---- covariance ----


def test_the_covariance_is_that_of_the_path_in_the_order_of_ros() -> None:
    slam = Slam(settings=CUTS)
    for i in range(18):
        rgb, depth = images(i)
        step = slam.track(rgb, depth, K, i / 30, depth_scale=1000)
        assert step.covariance is not None and step.covariance.shape == (6, 6)
        if step.is_keyframe or len(slam.keyframe_indices) > 1:
            path = PathCovariance.of(slam.checkpoint())
            assert path is not None
            J = se3.displacement(step.T_world_camera)
            assert np.allclose(step.covariance, J @ path.of_frame(i) @ J.T, rtol=1e-6, atol=1e-15)
        if i:
            assert np.linalg.eigvalsh(step.covariance).min() > 0
            assert 1e-4 < np.sqrt(np.diag(step.covariance)[:3]).max() < 0.05
        else:
            assert not step.covariance.any()
    assert len(slam.atlas.anchors) > 2
    assert np.trace(slam.covariance()) > 0


def test_a_lost_frame_has_no_covariance_and_an_uncertain_pose() -> None:
    slam = followed(count=4)
    rgb, depth = images(4)
    step = slam.track(np.zeros_like(rgb), np.zeros_like(depth), K, 4 / 30, depth_scale=1000)
    assert step.lost and step.state == "lost" and step.covariance is None and step.p_off > 0.5
    assert slam.steps[-2].p_off < 0.5


# ---- functions that are called ----


LOOPS = SETTINGS | {
    "input.width": "80", "submaps.frames": "8",
    "loops.close": "true", "loops.near_m": "5",
    "loops.min_interval": "1",
}  # fmt: skip


def test_functions_are_called_at_corrections() -> None:
    slam, seen = Slam(settings=LOOPS), list[Correction]()
    slam.on_correction(seen.append)
    poses: dict[int, np.ndarray] = {}

    @slam.on_correction
    def moved(correction: Any) -> None:
        path = slam.trajectory().T_world_camera
        assert np.array_equal(correction.T_world_camera, path[correction.frames])
        was = np.stack([poses[i] for i in correction.frames])
        assert np.allclose(correction.moved_m, np.linalg.norm((path[correction.frames] - was)[:, :3, 3], axis=1))

    for i in range(26):
        rgb, depth = images(i)
        slam.track(rgb, depth, K, i / 30, depth_scale=1000)
        poses = dict(enumerate(slam.trajectory().T_world_camera))
    slam.finish()
    assert any(loop.accepted for loop in slam.loops)
    reasons = [correction.reason for correction in seen]
    assert set(reasons[:-1]) == {"loop"} and reasons[-1] == "final map"
    assert all(len(c.frames) == len(c.moved_m) and c.moved_m.max() > 0 for c in seen)


def test_functions_change_no_byte(run: Slam) -> None:
    slam = Slam(settings=SETTINGS)
    slam.on_correction(list[Correction]().append)
    followed(slam=slam)
    slam.finish()
    assert contents(slam) == contents(run)


def test_a_function_that_fails_leaves_the_state_valid() -> None:
    usual, slam, failed = Slam(settings=LOOPS), Slam(settings=LOOPS), list[str]()

    @slam.on_correction
    def fails(correction: Correction) -> None:
        raise ValueError(f"{correction.reason} at {slam.steps[-1].index}")

    for i in range(26):
        rgb, depth = images(i)
        usual.track(rgb, depth, K, i / 30, depth_scale=1000)
        try:
            slam.track(rgb, depth, K, i / 30, depth_scale=1000)
        except ValueError as problem:
            failed.append(str(problem))
            assert slam.steps[-1].index == i
    usual.finish()
    with pytest.raises(ValueError, match="final map at 25"):
        slam.finish()
    assert failed and all(text.startswith("loop at ") for text in failed) and contents(slam) == contents(usual)


# ---- in real time ----


def test_real_time_gives_the_same_poses_and_covariances_if_mapping_keeps_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RealTimeConfig, "spare_iterations", 0)
    monkeypatch.setattr(RealTimeConfig, "keyframe_deg", 0.0)
    usual, system = Slam(settings=CUTS), RealTime(Slam(settings=CUTS), AtOnce())
    for i in range(14):
        rgb, depth = images(i)
        a, b = (each.track(rgb, depth, K, i / 30, depth_scale=1000) for each in (usual, system))
        assert np.allclose(a.T_world_camera, b.T_world_camera, atol=2e-3) and a.covariance is not None
        if a.is_keyframe:  # its own motion is measured when it is mapped
            assert b.covariance is not None and np.linalg.eigvalsh(b.covariance).min() >= 0
        else:
            assert np.allclose(a.covariance, b.covariance, rtol=1e-6)
    with pytest.raises(SourceError, match="repeats"):
        system.track(rgb, depth, K, 13 / 30, depth_scale=1000)
    system.settle()
    assert np.array_equal(usual.trajectory().T_world_camera, system.trajectory().T_world_camera)


@pytest.mark.parametrize(
    "schedule", [AtOnce(), pytest.param(Drawn(3), marks=pytest.mark.slow), None], ids=["at once", "drawn", "thread"]
)
def test_real_time_calls_functions_on_the_thread_of_the_caller(schedule: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RealTimeConfig, "keyframe_deg", 0.0)
    # Frames of a thread take so long that it closes a loop before the last one.
    size, count = ({}, 26) if schedule else ({"input.width": "160"}, 40)
    system = RealTime(Slam(settings=LOOPS | size), schedule)
    seen, threads = list[Correction](), set[int]()
    system.on_correction(seen.append)
    system.on_correction(lambda correction: threads.add(threading.get_ident()))
    for i in range(count):
        rgb, depth = images(i)
        step = system.track(rgb, depth, K, i / 30, depth_scale=1000)
        assert step.covariance is not None and np.isfinite(step.covariance).all()
    early = len(seen)  # on a busy machine the thread closes its loop in `finish`, with the final map
    system.finish()
    assert seen[-1].reason == "final map" and threads == {threading.get_ident()}
    assert all(c.reason == "loop" for c in seen[:-1]) and any(loop.accepted for loop in system.loops)
    assert len(seen) > 1 or (not early and schedule is None)


def test_corrections_after_the_last_keyframe_are_reported_in_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RealTimeConfig, "keyframe_deg", 0.0)
    system = RealTime(Slam(settings=LOOPS), AtOnce())
    seen, closed = list[Correction](), False
    system.on_correction(seen.append)
    for i in range(60):
        before = len(system.slam.loops)
        rgb, depth = images(i)
        step = system.track(rgb, depth, K, i / 30, depth_scale=1000)
        newest = system.slam.loops[before:]
        if closed := not step.is_keyframe and any(loop.accepted for loop in newest):
            break
    assert closed
    path, early = system.slam.trajectory().T_world_camera, len(seen)
    system.settle()
    assert len(seen) == early + 1 and seen[-1].reason == "loop"
    assert np.array_equal(seen[-1].T_world_camera, path[seen[-1].frames])


def test_in_real_time_a_function_that_fails_leaves_the_state_valid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RealTimeConfig, "keyframe_deg", 0.0)
    system = RealTime(Slam(settings=LOOPS), AtOnce())

    @system.on_correction
    def fails(correction: Correction) -> None:
        raise ValueError(correction.reason)

    for i in range(26):
        rgb, depth = images(i)
        with suppress(ValueError):
            system.track(rgb, depth, K, i / 30, depth_scale=1000)
        assert system.newest_step().index == i  # type: ignore[union-attr]
    with pytest.raises(ValueError, match=r"loop|final map"):
        system.finish()
    assert len(system.trajectory()) == 26 and system.valid().all()
