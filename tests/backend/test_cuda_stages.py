"""Hold the book-keeping of a CUDA view's stages to a clock that the test turns, on the emulated kernels."""

from collections.abc import Iterator
from dataclasses import dataclass, field as dataclass_field
from typing import Any

import numpy as np
import pytest
import torch

from emulated_cuda import Emulator
from sigmasplat.data.field import GaussianField
from sigmasplat.plugins.cuda import launch as cuda_launch
from sigmasplat.plugins.cuda.launch import STAGES, Stages
from sigmasplat.plugins.cuda.mapping_step import CudaStep
from sigmasplat.plugins.cuda.view import CudaView
from sigmasplat.slam.results import KERNELS
from splat_fields import OPTIONS, params_of, there_and_back
from splat_scenes import scene

CPU = torch.device("cpu")


@dataclass
class Device:
    """A device whose work takes the time that a test says, and which is done as far as it says."""

    now_ms: float = 0.0
    done_ms: float = float("inf")
    made: int = 0
    waits: int = 0

    def event(self) -> "Mark":
        self.made += 1
        return Mark(self)


@dataclass
class Mark:
    """An event on it."""

    device: Device
    at_ms: float = dataclass_field(default=-1.0)

    def record(self) -> None:
        self.at_ms = self.device.now_ms

    def query(self) -> bool:
        return self.at_ms <= self.device.done_ms

    def synchronize(self) -> None:
        self.device.waits += 1
        self.device.done_ms = max(self.device.done_ms, self.at_ms)

    def elapsed_time(self, end: Any) -> float:
        assert self.query() and end.query(), "torch refuses to time what has not passed"
        return float(end.at_ms - self.at_ms)


@pytest.fixture
def measured() -> Iterator[Device]:
    cuda_launch.measure()
    yield Device()
    cuda_launch.measure(False)


def test_times_are_booked_by_stage_without_waiting(measured: Device) -> None:
    stages = Stages(measured.event)
    for k in range(50):
        for stage, took in zip(("sort", "blend"), (2.0, 5.0), strict=True):
            with stages.of(stage):
                measured.now_ms += took
            measured.now_ms += 1.0  # between stages
        measured.done_ms = measured.now_ms - 20.0 * (k % 3)  # the device is up to so far behind
    assert measured.waits == 0 and measured.made < 30, "events that have passed are used again"
    np.testing.assert_allclose(stages.seconds, [0.0, 0.1, 0.25, 0.0, 0.0])
    assert measured.waits == 1
    np.testing.assert_allclose(stages.seconds, [0.0, 0.1, 0.25, 0.0, 0.0])
    assert measured.waits == 1, "nothing was left to wait for"


def test_what_has_been_read_stays_as_it_was(measured: Device) -> None:
    stages = Stages(measured.event)
    before = stages.seconds
    with stages.of("project"):
        measured.now_ms += 4.0
    assert not before.any() and stages.seconds[0] == pytest.approx(4e-3)


def test_a_stage_that_fails_is_booked_too(measured: Device) -> None:
    stages = Stages(measured.event)
    with pytest.raises(ValueError, match="no"), stages.of("blend"):
        measured.now_ms += 3.0
        raise ValueError("no")
    assert stages.seconds[2] == pytest.approx(3e-3)


def test_nobody_asked_nothing_is_recorded() -> None:
    device = Device()
    stages = Stages(device.event)
    with stages.of("blend"):
        device.now_ms += 3.0
    assert device.made == 0 and not stages.seconds.any()


def test_every_stage_of_a_view_is_counted(measured: Device, emulator: Emulator) -> None:
    """Each launch takes a millisecond, and so does a sort; the step's own kernels belong to the last stage."""
    s = scene("random", 60)
    with emulator.standing_in(), pytest.MonkeyPatch.context() as patch:
        call, sort = Emulator.__call__, torch.sort

        def timed(*arguments: Any, **named: Any) -> Any:
            measured.now_ms += 1.0
            return (call if isinstance(arguments[0], Emulator) else sort)(*arguments, **named)

        patch.setattr(Emulator, "__call__", timed)
        patch.setattr(torch, "sort", timed)
        plain = CudaView(s.camera, OPTIONS, True, CPU)
        plain.stages = Stages(measured.event)
        before = plain.seconds
        there_and_back(plain, params_of(s), s.T_camera_world.numpy())
        np.testing.assert_allclose((plain.seconds - before) * 1000, [1, 3, 1, 2, 1])
        before = plain.seconds
        plain.forward(params_of(s), s.T_camera_world.numpy())
        plain.backward_pose(params_of(s))
        np.testing.assert_allclose((plain.seconds - before) * 1000, [1, 3, 1, 2, 1])
        before = plain.seconds
        field = GaussianField(params_of(s), steps=1)
        from splat_fits import RATES

        CudaStep(plain).splats(field, RATES, {}, 0)
        np.testing.assert_allclose((plain.seconds - before) * 1000, [0, 0, 0, 2, 3])


def test_stages_are_those_that_a_step_logs() -> None:
    assert STAGES == KERNELS
