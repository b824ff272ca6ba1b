"""Launch the CUDA kernels: convert the arguments to the kernels' parameters, and load machine code once per device."""

import struct
from array import array
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import BackendError
from sigmasplat.plugins.cuda import cubins

THREADS = 256
"""Number of threads per block (native/cuda/device.cuh)."""
Struct = tuple["Tensor | int | None", ...]
Argument = Tensor | NDArray[Any] | Struct | int | float | None
"""A tensor is a pointer, None a null pointer. An array is a struct passed by value; a tuple is a struct of pointers and
64-bit numbers. int has 32 bits, float is single precision."""


class Launcher(Protocol):
    """Something that runs a kernel: a device, or its emulation in tests."""

    def __call__(self, features: int, kernel: str, blocks: int, *arguments: Argument) -> None:
        """Run blocks of `THREADS` threads of a kernel on torch's stream; features: the feature count of the kernel's
        program."""


def blocks_for(threads: int) -> int:
    """Return the number of blocks for this many threads."""
    return -(-threads // THREADS)


def laid_out(arguments: tuple[Argument, ...]) -> "array[int]":
    """Return the arguments in memory, in units of 64 bits: first the address of each argument, then the arguments."""
    begins, words = list[int](), list[int]()
    for argument in arguments:
        begins.append(len(words))
        words += _words_of(argument)
    memory = array("Q", begins + words)
    address = memory.buffer_info()[0] + 8 * len(begins)
    for i, begin in enumerate(begins):
        memory[i] = address + 8 * begin
    return memory


def _words_of(argument: Argument) -> Iterable[int]:
    if argument is None or isinstance(argument, Tensor):
        return (_address(argument),)
    if isinstance(argument, tuple):
        return [a % 2**64 if isinstance(a, int) else _address(a) for a in argument]
    if isinstance(argument, np.ndarray):
        given = argument.tobytes()
        return array("Q", given + bytes(-len(given) % 8))
    return (int.from_bytes(struct.pack("<f" if isinstance(argument, float) else "<i", argument), "little"),)


def _address(tensor: Tensor | None) -> int:
    if tensor is None:
        return 0
    assert tensor.is_contiguous(), "kernels read whole arrays"
    return tensor.data_ptr()


class HostCopy:
    """A copy of a tensor to the host, made at this point of the device's queue; the host does not wait."""

    def __init__(self, values: Tensor) -> None:
        self._on_host = torch.empty(values.shape, dtype=values.dtype, pin_memory=values.is_cuda)
        self._on_host.copy_(values, non_blocking=values.is_cuda)
        self._copied: torch.cuda.Event | None = None
        if values.is_cuda:
            self._copied = torch.cuda.Event()  # type: ignore[no-untyped-call]
            self._copied.record(torch.cuda.current_stream(values.device))

    def read(self) -> NDArray[Any]:
        """Return the values. Waits until the copy has finished."""
        if self._copied is not None:
            self._copied.synchronize()
        return np.asarray(self._on_host.numpy())


class Device:
    """The kernels on one CUDA device; each program is compiled at its first use."""

    def __init__(self, device: torch.device) -> None:
        """Raises BackendError with the reason if the CUDA backend cannot run."""
        refuse_where_missing()
        self._device = device
        self._kernels: dict[tuple[int, str], Any] = {}
        self._modules: dict[int, Any] = {}
        self._context = _primary_context(device)
        self.architecture = cubins.target_of(torch.cuda.get_device_capability(device))

    def __call__(self, features: int, kernel: str, blocks: int, *arguments: Argument) -> None:
        """Run a kernel on the device's current stream. Raises BackendError if the driver refuses."""
        if blocks == 0:
            return
        memory = laid_out(arguments)
        stream = torch.cuda.current_stream(self._device).cuda_stream
        with self._current() as driver:
            function = self._kernel(features, kernel)
            found = driver.cuLaunchKernel(function, blocks, 1, 1, THREADS, 1, 1, 0, stream, memory.buffer_info()[0], 0)
        _checked(found, f"the CUDA kernel {kernel} cannot be launched")

    @contextmanager
    def _current(self) -> Iterator[Any]:
        """Make torch's context of the device current in this thread, because threads of autograd start without a
        context."""
        from cuda.bindings import driver

        _checked(driver.cuCtxPushCurrent(self._context), f"{self._device} cannot be used")
        try:
            yield driver
        finally:
            driver.cuCtxPopCurrent()

    def _kernel(self, features: int, name: str) -> Any:
        if (features, name) not in self._kernels:
            from cuda.bindings import driver

            found = driver.cuModuleGetFunction(self._module(features), name.encode())
            self._kernels[features, name] = _checked(found, f"the CUDA kernel {name} is not in its program")
        return self._kernels[features, name]

    def _module(self, features: int) -> Any:
        if features not in self._modules:
            from cuda.bindings import driver

            code = cubins.cubin(features, self.architecture)
            found = driver.cuModuleLoadData(code)
            self._modules[features] = _checked(found, f"the CUDA kernels for {self.architecture} cannot be loaded")
        return self._modules[features]


def _primary_context(device: torch.device) -> Any:
    """Return the context that torch uses on a device."""
    from cuda.bindings import driver

    _checked(driver.cuInit(0), "the CUDA driver cannot be used")
    ordinal = _checked(driver.cuDeviceGet(device.index), f"{device} cannot be found")
    return _checked(driver.cuDevicePrimaryCtxRetain(ordinal), f"{device} cannot be used")


def _checked(found: tuple[Any, ...], failure: str) -> Any:
    """Return the result of a driver call. Raises BackendError with its reason if it failed."""
    result, *values = found
    if result.value != 0:
        raise BackendError(f"{failure}: {result.name}; run `sigmasplat doctor` for details")
    return values[0] if values else None


def missing() -> str | None:
    """Return one line that says why the CUDA backend cannot run on this machine and how to fix it; None if it can."""
    if torch.version.cuda is None:
        return f"torch {torch.__version__} is built without CUDA; install a torch with CUDA (https://pytorch.org)"
    if not torch.cuda.is_available():
        return "torch finds no CUDA device; check that a GPU and its driver are installed"
    try:
        compiler = cubins.compiler_version()
    except BackendError as problem:
        return f"{problem}"
    from cuda.bindings import driver

    version = driver.cuDriverGetVersion()[1]
    if version // 1000 >= int(compiler.split(".")[0]):
        return None
    old = f"the driver is for CUDA {version // 1000}.{version % 1000 // 10}, too old for NVRTC {compiler}"
    return f"{old}; update it, or {cubins.INSTALL_OLDER}"


def refuse_where_missing() -> None:
    """Raise BackendError with the reason if the CUDA backend cannot run."""
    reason = missing()
    if reason:
        raise BackendError(f"the CUDA backend cannot run: {reason}")


_device = cache(Device)


def this_device() -> torch.device:
    """Return torch's current CUDA device. Raises BackendError with the reason if the CUDA backend cannot run."""
    refuse_where_missing()
    return torch.device("cuda", torch.cuda.current_device())


def launcher_for(device: torch.device) -> Launcher:
    """Return the launcher for tensors of a device. Raises BackendError if there is none."""
    if device.type != "cuda":
        raise BackendError(f"the cuda backend takes tensors on a CUDA device; these are on {device}")
    return _device(this_device() if device.index is None else device)
