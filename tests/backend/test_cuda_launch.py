"""Launch through the driver's interface, with a driver that emulates: what the real one would be handed."""

import ctypes
from contextlib import nullcontext
from enum import Enum
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from emulated_cuda import Emulator
from sigmasplat.errors import BackendError
from sigmasplat.native import cubins
from sigmasplat.render import cuda, cuda_launch
from sigmasplat.render.cuda_launch import THREADS, Device
from splat_scenes import gradients, scene

bindings = pytest.importorskip("cuda.bindings", reason="needs pip install 'sigmasplat[gpu]'")
core = pytest.importorskip("cuda.core", reason="needs pip install 'sigmasplat[gpu]'")


class Result(Enum):
    CUDA_SUCCESS = 0
    CUDA_ERROR_ILLEGAL_ADDRESS = 700


class Driver:
    """Stands in for cuda.bindings.driver and for a loaded program: functions are numbers, memory is the host's."""

    CUresult, CUfunction = Result, int

    def __init__(self, emulator: Emulator) -> None:
        self.emulator, self.kernels = emulator, list[tuple[int, str]]()
        self.answer = Result.CUDA_SUCCESS

    def from_cubin(self, code: bytes, name: str) -> SimpleNamespace:
        features = int(code)
        assert name == f"sigmasplat-{features}"
        return SimpleNamespace(get_kernel=lambda kernel: SimpleNamespace(handle=self.number_of(features, kernel)))

    def number_of(self, features: int, kernel: str) -> int:
        assert kernel in cubins.kernel_names(features)
        self.kernels.append((features, kernel))
        return len(self.kernels) - 1

    def cuLaunchKernel(self, function: int, *given: int) -> tuple[Result]:
        blocks, one, again, threads, _, _, shared, _stream, parameters, extra = given
        assert (one, again, threads, shared, extra) == (1, 1, THREADS, 0, 0) and blocks > 0
        features, kernel = self.kernels[function]
        run = self.emulator._library(features).emulate
        assert run(kernel.encode(), blocks, threads, ctypes.c_void_p(parameters), 0) is None
        return (self.answer,)


@pytest.fixture
def driver(emulator: Emulator, monkeypatch: pytest.MonkeyPatch) -> Driver:
    fake = Driver(emulator)
    monkeypatch.setattr(bindings, "driver", fake, raising=False)
    monkeypatch.setattr(core, "ObjectCode", fake)
    monkeypatch.setattr(cubins, "cubin", lambda features, architecture: str(features).encode())
    monkeypatch.setattr(torch.cuda, "device", nullcontext)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=5))
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    return fake


def test_kernels_are_handed_what_they_ask_for(
    driver: Driver, emulator: Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    s = scene("random", 60).to(torch.float32)
    with emulator.standing_in():
        want = gradients(cuda, s)
    device = Device(torch.device("cpu"))
    assert device.architecture == "sm_90"
    monkeypatch.setattr(cuda_launch, "launcher_for", lambda _: device)
    got = gradients(cuda, s)
    assert all(torch.equal(got[name], want[name]) for name in want)
    assert len(driver.kernels) == len(set(driver.kernels)), "each kernel is looked up once"


def test_a_kernel_that_cannot_be_launched_says_why(driver: Driver, monkeypatch: pytest.MonkeyPatch) -> None:
    driver.answer = Result.CUDA_ERROR_ILLEGAL_ADDRESS
    device: Any = Device(torch.device("cpu"))
    monkeypatch.setattr(cuda_launch, "launcher_for", lambda _: device)
    s = scene("random", 60).to(torch.float32)
    with pytest.raises(BackendError, match="project_splats cannot be launched: CUDA_ERROR_ILLEGAL_ADDRESS"):
        cuda.project(s.means, s.quats, s.scales, s.T_camera_world, s.camera, s.options)


def test_arguments_are_laid_out_as_parameters() -> None:
    values, struct = torch.arange(3.0), np.array((1, 2.5), dtype="i4,f4")
    memory, addresses = cuda_launch.laid_out((values, None, 7, 0.5, struct, (values, None, -1)))

    def at(index: int, kind: Any) -> Any:
        return kind.from_address(int(addresses[index])).value

    assert at(0, ctypes.c_uint64) == values.data_ptr() and at(1, ctypes.c_uint64) == 0
    assert at(2, ctypes.c_int32) == 7 and at(3, ctypes.c_float) == 0.5
    assert bytes(memory)[32:40] == struct.tobytes()
    pointers = (ctypes.c_int64 * 3).from_address(int(addresses[5]))
    assert list(pointers) == [values.data_ptr(), 0, -1]
    assert all(int(address) % 8 == 0 for address in addresses)
