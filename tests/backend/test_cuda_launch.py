"""Launch through the driver's interface, with a driver that emulates: what the real one would be handed."""

import ctypes
import threading
from enum import Enum
from struct import error as StructError
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from cuda_kernels import kernel_names
from emulated_cuda import Emulator
from sigmasplat.errors import BackendError
from sigmasplat.plugins.cuda import cubins, launch as cuda_launch, operators as cuda
from sigmasplat.plugins.cuda.launch import THREADS, Device
from splat_scenes import gradients, scene

# Both before a test puts another driver in its place, or the import of one would put it back.
pytest.importorskip("cuda.bindings.driver", reason="needs pip install 'sigmasplat[cuda]'")
pytest.importorskip("cuda.bindings.nvrtc", reason="needs pip install 'sigmasplat[cuda]'")
bindings = pytest.importorskip("cuda.bindings")
CONTEXT, ORDINAL, STREAM = "the context of device 3", 3, 5


class Result(Enum):
    CUDA_SUCCESS = 0
    CUDA_ERROR_INVALID_CONTEXT = 201
    CUDA_ERROR_ILLEGAL_ADDRESS = 700


class Driver:
    """Stands in for cuda.bindings.driver: functions are numbers, memory is the host's, every thread begins without a
    context."""

    def __init__(self, emulator: Emulator) -> None:
        self.emulator, self.kernels = emulator, list[tuple[int, str]]()
        self.answer = Result.CUDA_SUCCESS
        self.thread = threading.local()

    def cuInit(self, flags: int) -> tuple[Result]:
        return (Result.CUDA_SUCCESS,)

    def cuDeviceGet(self, index: int) -> tuple[Result, int]:
        return Result.CUDA_SUCCESS, index

    def cuDevicePrimaryCtxRetain(self, ordinal: int) -> tuple[Result, str]:
        return Result.CUDA_SUCCESS, f"the context of device {ordinal}"

    def cuCtxPushCurrent(self, context: str) -> tuple[Result]:
        self.thread.contexts = [*self.contexts, context]
        return (Result.CUDA_SUCCESS,)

    def cuCtxPopCurrent(self) -> tuple[Result, str]:
        *self.thread.contexts, last = self.contexts
        return Result.CUDA_SUCCESS, last

    @property
    def contexts(self) -> list[str]:
        return getattr(self.thread, "contexts", [])

    def cuModuleLoadData(self, code: bytes) -> tuple[Result, int]:
        assert self.contexts[-1:] == [CONTEXT], "a module is loaded into the current context"
        return Result.CUDA_SUCCESS, int(code)

    def cuModuleGetFunction(self, module: int, name: bytes) -> tuple[Result, int]:
        assert name.decode() in kernel_names(module)
        self.kernels.append((module, name.decode()))
        return Result.CUDA_SUCCESS, len(self.kernels) - 1

    def cuLaunchKernel(self, function: int, *given: int) -> tuple[Result]:
        blocks, one, again, threads, _, _, shared, stream, parameters, extra = given
        assert (one, again, threads, shared, stream, extra) == (1, 1, THREADS, 0, STREAM, 0) and blocks > 0
        if self.contexts[-1:] != [CONTEXT]:
            return (Result.CUDA_ERROR_INVALID_CONTEXT,)
        features, kernel = self.kernels[function]
        run = self.emulator.library(features).emulate
        assert run(kernel.encode(), blocks, threads, ctypes.c_void_p(parameters), 0) is None
        return (self.answer,)


@pytest.fixture
def driver(emulator: Emulator, monkeypatch: pytest.MonkeyPatch) -> Driver:
    fake = Driver(emulator)
    monkeypatch.setattr(bindings, "driver", fake, raising=False)
    monkeypatch.setattr(cuda_launch, "missing", lambda: None)
    monkeypatch.setattr(cubins, "cubin", lambda features, architecture: str(features).encode())
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=STREAM))
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (9, 0))
    return fake


@pytest.fixture
def device(driver: Driver, monkeypatch: pytest.MonkeyPatch) -> Device:
    made = Device(torch.device("cuda", ORDINAL))
    monkeypatch.setattr(cuda_launch, "launcher_for", lambda _: made)
    return made


def test_kernels_are_handed_what_they_ask_for(driver: Driver, device: Device, emulator: Emulator) -> None:
    s = scene("random", 60).to(torch.float32)
    with emulator.standing_in():
        want = gradients(cuda, s)
    assert device.architecture == "sm_90"
    got = gradients(cuda, s)
    assert all(torch.equal(got[name], want[name]) for name in want)
    assert len(driver.kernels) == len(set(driver.kernels)), "each kernel is looked up once"
    assert driver.contexts == [], "what was current before is so again"


def projected(s: Any) -> Any:
    return cuda.project(s.means, s.quats, s.scales, s.T_camera_world, s.camera, s.options)


def test_a_thread_without_a_context_is_given_one(driver: Driver, device: Device) -> None:
    """Autograd calls a backward pass from a thread of its own, in which torch may have made no context current."""
    s, found = scene("random", 60).to(torch.float32), list[Any]()
    other = threading.Thread(target=lambda: found.append(projected(s)))
    other.start()
    other.join()
    assert torch.equal(found[0].means2d, projected(s).means2d)


def test_another_devices_context_is_put_back(driver: Driver, device: Device) -> None:
    driver.cuCtxPushCurrent("the context of device 0")
    projected(scene("random", 60).to(torch.float32))
    assert driver.contexts == ["the context of device 0"]


def test_a_kernel_that_cannot_be_launched_says_why(driver: Driver, device: Device) -> None:
    driver.answer = Result.CUDA_ERROR_ILLEGAL_ADDRESS
    with pytest.raises(BackendError, match="project_splats cannot be launched: CUDA_ERROR_ILLEGAL_ADDRESS"):
        projected(scene("random", 60).to(torch.float32))
    assert driver.contexts == []


def test_a_missing_device_is_refused_before_the_driver_is_asked(driver: Driver, monkeypatch: Any) -> None:
    monkeypatch.setattr(cuda_launch, "missing", lambda: "there is none")
    with pytest.raises(BackendError, match="the CUDA backend cannot run: there is none"):
        Device(torch.device("cuda", 0))


def test_arguments_are_laid_out_as_parameters() -> None:
    values, struct = torch.arange(3.0), np.array((1, 2.5, 3), dtype="i4,f4,i4")
    memory = cuda_launch.laid_out((values, None, -7, 0.5, struct, (values, None, -1), 9))

    def at(index: int, kind: Any) -> Any:
        return kind.from_address(memory[index]).value

    assert at(0, ctypes.c_uint64) == values.data_ptr() and at(1, ctypes.c_uint64) == 0
    assert at(2, ctypes.c_int32) == -7 and at(3, ctypes.c_float) == 0.5 and at(6, ctypes.c_int32) == 9
    assert bytes((ctypes.c_char * 12).from_address(memory[4])) == struct.tobytes()
    pointers = (ctypes.c_int64 * 3).from_address(memory[5])
    assert list(pointers) == [values.data_ptr(), 0, -1]
    assert all(address % 8 == 0 for address in memory[:7]) and memory.buffer_info()[0] + 7 * 8 == memory[0]
    assert memory[6] + 8 == memory.buffer_info()[0] + 8 * len(memory), "nothing lies behind the last"


def test_a_number_too_large_for_its_parameter_is_refused() -> None:
    with pytest.raises(StructError):
        cuda_launch.laid_out((2**31,))
