"""Stand in for a CUDA device: tensors that say they lie on cuda:0 while their memory is the host's.

What mixes devices fails as it would on a GPU, what makes the host wait is counted, memory that nobody wrote is not
zero, and what travels without anyone waiting arrives when its event is waited for. Kernels are the emulator's.
"""

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

import sigmasplat
from emulated_cuda import FLAGS, HERE, Emulator
from sigmasplat.plugins.cuda import launch as cuda_launch
from sigmasplat.plugins.cuda.launch import Argument
from sigmasplat.render.backend import automatic

DEVICE, HOST = torch.device("cuda", 0), torch.device("cpu")
SCALARS = {
    "add", "sub", "rsub", "mul", "div", "true_divide", "floor_divide", "remainder", "pow", "atan2", "maximum",
    "minimum", "fmax", "fmin", "eq", "ne", "lt", "le", "gt", "ge", "bitwise_and", "bitwise_or", "bitwise_xor",
    "logical_and", "logical_or", "logical_xor", "where", "fill", "masked_fill", "copy",
}  # fmt: skip
"""Operators that take a number that lies on the host (no dimension) beside tensors of the device."""
INDEXING = {"index", "index_put", "_index_put_impl", "_unsafe_index"}
"""Operators that take indices from the host too: they are sent over, and the host waits."""
WAITING = {
    "_local_scalar_dense", "nonzero", "masked_select", "equal", "unique", "_unique2", "unique_dim", "bincount",
    "unique_consecutive", "_linalg_check_errors",
}  # fmt: skip
"""Operators whose result, or its size, the host needs."""
ALLOCATING = {"empty", "empty_strided", "new_empty", "empty_like", "detach", "alias", "is_pinned", "_pin_memory"}
"""Operators that launch no kernel."""
PACKAGE = str(Path(sigmasplat.__file__).parent)
RUBBISH = 99
"""What integers hold that nobody wrote; other numbers are NaN."""


class DeviceTensor(Tensor):
    """A tensor on the stand-in device; `memory` is the tensor on the host that it really is."""

    memory: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, memory: Tensor) -> "DeviceTensor":
        made = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls, memory.size(), strides=memory.stride(), storage_offset=memory.storage_offset(), dtype=memory.dtype,
            device=DEVICE,
        )  # fmt: skip
        made.memory = memory
        return made

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f"{function}: a tensor of the stand-in device outlived it")

    def numpy(self, **_: Any) -> Any:  # type: ignore[override]
        raise TypeError("can't convert cuda:0 device type tensor to numpy; use Tensor.cpu() first")

    def __dlpack__(self, **_: Any) -> Any:  # type: ignore[override]
        raise TypeError("a tensor on cuda:0 is handed to code for the host")

    def new_tensor(self, data: Any, *, dtype: torch.dtype | None = None, **_: Any) -> Tensor:  # type: ignore[override]
        return torch.tensor(data, dtype=dtype or self.dtype).to(DEVICE)

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def data_ptr(self) -> int:
        raise AssertionError("only a kernel's launch may take the address of device memory")

    def __repr__(self, **_: Any) -> str:  # type: ignore[override]
        return f"on {DEVICE}: {self.memory!r}"


@dataclass(frozen=True)
class Copy:
    """So many numbers sent between host and device, for whom, and whether the host waited (pageable memory)."""

    to_device: bool
    numbers: int
    by: str
    waited: bool = True


@dataclass(eq=False)
class StandIn(TorchDispatchMode):
    """The device while it is there: `waits` says who made the host wait and by what, `copies` what travelled,
    `launches` the kernels that were launched, ours by name and torch's by operator."""

    emulator: Emulator
    launches: list[str] = field(default_factory=list)
    waits: list[tuple[str, str]] = field(default_factory=list)
    copies: list[Copy] = field(default_factory=list)
    _on_the_way: list[tuple[Tensor, Tensor, bool]] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def forget(self) -> None:
        """Count from zero."""
        self.waits.clear()
        self.copies.clear()
        self.launches.clear()

    def waited_in(self) -> list[str]:
        """Return who made the host wait, as file names in order."""
        return [who for who, _ in self.waits]

    # ---- what operators do ----

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function._can_decompose():  # in inference mode operators made of others come whole
            with self:
                return function.decompose(*args, **(kwargs or {}))
        name, kwargs = function.overloadpacket.__name__.removesuffix("_"), dict(kwargs or {})
        tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        there = any(isinstance(x, DeviceTensor) for x in tensors)
        asked = kwargs.get("device")
        wanted = there if asked is None else torch.device(asked).type == "cuda"
        if there and name not in ("copy", "_to_copy"):
            self._refuse_mixtures(function, name, args, kwargs, tensors)
        self._note(function, name, args, kwargs)
        if name == "copy" and isinstance(args[0], DeviceTensor) != isinstance(args[1], DeviceTensor):
            return self._send(args[0], args[1], bool(kwargs.get("non_blocking") or args[2:]))
        if name == "_to_copy" and wanted != there:
            self._travelled(wanted, args[0].numel(), bool(kwargs.get("non_blocking")) and _is_pinned(args[0]))
        if name == "is_pinned":
            return _is_pinned(args[0])
        if wanted and _computes(function, name):
            self.launches.append(f"torch.{name}")
        return self._run(function, name, args, kwargs, wanted)

    def _run(self, function: Any, name: str, args: Any, kwargs: dict[str, Any], wanted: bool) -> Any:
        """Run an operator on the memory of its tensors; what it returns lies on the device if that is `wanted`."""
        pinned = bool(kwargs.pop("pin_memory", False)) or name == "_pin_memory"
        if kwargs.get("device") is not None:
            kwargs["device"] = HOST
        if wanted and kwargs.get("generator") is not None:
            raise RuntimeError("Expected a 'cuda' device type for generator but found 'cpu'")
        plain_args, plain_kwargs = tree_map_only(DeviceTensor, lambda x: x.memory, (args, kwargs))
        found = plain_args[0].clone() if name == "_pin_memory" else function(*plain_args, **plain_kwargs)
        returns = function._schema.returns
        if returns and returns[0].alias_info is not None and returns[0].alias_info.is_write:
            assert isinstance(args[0], Tensor) and args[0].shape == found.shape, f"{function} is not stood in for"
            return args[0]
        if isinstance(found, Tensor) and name in ("empty", "empty_strided", "new_empty", "empty_like"):
            _spoil(found)
        if pinned:
            found.pinned = True
        return tree_map_only(Tensor, DeviceTensor, found) if wanted else found

    def _refuse_mixtures(self, function: Any, name: str, args: Any, kwargs: Any, tensors: list[Tensor]) -> None:
        """Raise what torch raises where tensors of host and device meet that may not."""
        if name in INDEXING and isinstance(args[0], DeviceTensor):
            tensors = [args[0], *args[2:3]]
        strangers = [x for x in tensors if not isinstance(x, DeviceTensor)]
        may = name in SCALARS or name in INDEXING
        written = any(not isinstance(x, DeviceTensor) for x in _written(function, args))
        if written or any(x.ndim or not may for x in strangers):
            raise RuntimeError(
                f"Expected all tensors to be on the same device, but found at least two devices, {DEVICE} and {HOST}! "
                f"({function}, {[tuple(x.shape) for x in strangers]} on the host)"
            )

    # ---- what is counted ----

    def _note(self, function: Any, name: str, args: Any, kwargs: Any) -> None:
        """Count an operator that makes the host wait."""
        if name in INDEXING and isinstance(args[0], DeviceTensor):
            given = [x for x in args[1] if x is not None]
            masks = [x for x in given if x.dtype in (torch.bool, torch.uint8)]
            value = args[2] if len(args) > 2 else None
            filled = value is not None and value.numel() == 1 and not isinstance(value, DeviceTensor) and not args[3:]
            if any(not isinstance(x, DeviceTensor) for x in given):
                self._travelled(True, sum(x.numel() for x in given))
            elif masks and not filled:
                self._wait(f"{name} by a mask")
        first = args[0] if args else None
        counted = name == "repeat_interleave" and kwargs.get("output_size") is None
        if isinstance(first, DeviceTensor) and (name in WAITING or counted):
            self._wait(name)
        if name == "where" and len(args) == 3:  # a number from the host is sent as a tensor
            for x in args:
                if not isinstance(x, DeviceTensor) and isinstance(args[0], DeviceTensor):
                    self._travelled(True, 1)

    def _wait(self, reason: str) -> None:
        self.waits.append((_who(), reason))
        self._arrive()

    def _travelled(self, to_device: bool, numbers: int, unwaited: bool = False) -> None:
        self.copies.append(Copy(to_device, numbers, _who(), not unwaited))
        if not unwaited:
            self._wait("sending" if to_device else "fetching")

    def _send(self, to: Tensor, source: Tensor, non_blocking: bool) -> Tensor:
        """Copy between host and device; from and to pinned memory nobody waits if asked so."""
        up = isinstance(to, DeviceTensor)
        unwaited = non_blocking and _is_pinned(source if up else to)
        self._travelled(up, source.numel(), unwaited)
        if isinstance(to, DeviceTensor):
            to.memory.copy_(source)
            if unwaited:
                self._on_the_way.append((source, source.clone(), True))
        else:
            assert isinstance(source, DeviceTensor)
            to.copy_(source.memory)
            if unwaited:
                self._on_the_way.append((to, to.clone(), False))
                _spoil(to)
        return to

    def _arrive(self) -> None:
        """Let arrive what is on its way: all that was asked for comes in order."""
        for host, values, sent in self._on_the_way:
            assert not sent or torch.equal(host, values), "pinned memory was written to while on its way to the device"
            host.copy_(values)
        self._on_the_way.clear()

    # ---- torch.cuda and the launcher ----

    def launch(self, features: int, kernel: str, blocks: int, *arguments: Argument) -> None:
        """Launch an emulated kernel. Its tensors must lie on the device: it could not read others."""
        given = [x for x in tree_leaves(arguments) if isinstance(x, Tensor)]
        assert all(isinstance(x, DeviceTensor) for x in given), f"{kernel} is handed memory of the host"
        self.launches.append(kernel)
        self.emulator(features, kernel, blocks, *tree_map_only(DeviceTensor, lambda x: x.memory, arguments))

    def event(self, **_: Any) -> SimpleNamespace:
        """Make an event; to synchronise with it is no wait worth counting where it has long happened."""
        return SimpleNamespace(
            record=lambda *_: None, synchronize=self._arrive, query=lambda: False, elapsed_time=lambda _: 0.0
        )


def _made_there(make: Any) -> Any:
    """Return torch.tensor or as_tensor for any device: torch makes such tensors where no mode sees it, on the host."""

    def made(data: Any, *args: Any, device: Any = None, **named: Any) -> Tensor:
        if device is None or (isinstance(data, Tensor) and data.device == torch.device(device)):
            return make(data, *args, **named)
        return make(data, *args, **named).to(device)

    return made


def _is_pinned(tensor: Tensor) -> bool:
    return getattr(tensor, "pinned", False)


def _written(function: Any, args: Any) -> list[Tensor]:
    """Return the tensors that an operator writes to."""
    named = zip(function._schema.arguments, args, strict=False)
    return [x for a, x in named if a.alias_info is not None and a.alias_info.is_write]


def _computes(function: Any, name: str) -> bool:
    """Return whether an operator launches at least one kernel: it neither makes a view nor only allocates memory."""
    returns = function._schema.returns
    view = bool(returns) and returns[0].alias_info is not None and not returns[0].alias_info.is_write
    return not view and name not in ALLOCATING


def _spoil(tensor: Tensor) -> None:
    """Fill memory with what nobody wrote."""
    tensor.fill_(torch.nan if tensor.dtype.is_floating_point else True if tensor.dtype == torch.bool else RUBBISH)


def _who() -> str:
    """Return the file of this package that torch was called from, autograd's thread having none."""
    frame: FrameType | None = sys._getframe()
    while frame is not None and not frame.f_code.co_filename.startswith(PACKAGE):
        frame = frame.f_back
    return Path(frame.f_code.co_filename).name if frame else "autograd or a test"


def library_in(folder: Path) -> Any:
    """Compile what lets a torch built without CUDA speak of a CUDA device (emulation/device.cpp), unless the folder has
    it, and load it.

    To be called before anything is differentiated: autograd starts a thread for each kind of device at first use.
    """
    torch_folder, made = Path(torch.__file__).parent, folder / "device.so"
    libraries = [f"-L{torch_folder / 'lib'}", "-lc10", "-ltorch_cpu", f"-Wl,-rpath,{torch_folder / 'lib'}"]
    flags = [*FLAGS, f"-isystem{torch_folder / 'include'}"]
    line = [os.environ.get("CXX") or "g++", *flags, str(HERE / "device.cpp"), "-o", str(made), *libraries]
    if not made.exists():
        done = subprocess.run(line, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(made))


@contextmanager
def standing_in(emulator: Emulator, library: Any) -> Iterator[StandIn]:
    """Let there be one CUDA device. What lies on it means nothing afterwards."""
    device = StandIn(emulator)
    properties = SimpleNamespace(name="stand-in", major=9, minor=0, total_memory=2**34)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda_launch, "launcher_for", lambda _: device.launch)
        patch.setattr(cuda_launch, "missing", lambda: None)
        patch.setattr(torch.cuda, "_lazy_init", lambda: None)
        patch.setattr(torch.cuda, "is_available", lambda: True)
        patch.setattr(torch.cuda, "device_count", lambda: 1)
        patch.setattr(torch.cuda, "current_device", lambda: 0)
        patch.setattr(torch.cuda, "get_device_properties", lambda _: properties)
        patch.setattr(torch.cuda, "current_stream", lambda *_: SimpleNamespace(cuda_stream=0))
        patch.setattr(torch.cuda, "device", lambda *_: nullcontext())
        patch.setattr(torch.cuda, "synchronize", lambda *_: device._wait("synchronize"))
        patch.setattr(torch.cuda, "Event", device.event)
        patch.setattr(torch, "tensor", _made_there(torch.tensor))
        patch.setattr(torch, "as_tensor", _made_there(torch.as_tensor))
        library.say_that_cuda_is_there(True)
        automatic.cache_clear()
        try:
            with device:
                yield device
        finally:
            automatic.cache_clear()
            library.say_that_cuda_is_there(False)
