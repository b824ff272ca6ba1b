"""Pretend that there is a device: tensors that say they lie on it, kept on the CPU.

They cannot be mixed with the CPU's, as on a real device, numpy cannot read them, and their kernels are emulated.
So everything above the kernels runs here as it would there.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from emulated_cuda import Emulator
from sigmasplat.render import cuda_launch

NAME = "pretended"
setup = getattr(backend_registration, "_setup_privateuseone_for_python_backend", None)
if setup is None:
    pytest.skip("this torch cannot register a device from Python", allow_module_level=True)
setup(rename=NAME)
DEVICE = torch.device(NAME, 0)
aten = torch.ops.aten
MIXING = {aten.copy_.default, aten._to_copy.default, aten.to.other}
"""What takes tensors of two devices; indices, too, may lie on the CPU."""
INDEXING = {aten.index.Tensor, aten.index_put_.default, aten.index_put.default, aten._index_put_impl_.default}


class There(Tensor):
    """A tensor on the pretended device; `here` holds its values."""

    here: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, here: Tensor) -> "There":
        made = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            here.shape,
            strides=here.stride(),
            storage_offset=here.storage_offset(),
            dtype=here.dtype,
            device=DEVICE,
        )
        made.here = here
        return made  # type: ignore[no-any-return]

    def __init__(self, here: Tensor) -> None:
        pass

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(function, args, dict(kwargs or {}))


def run(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Run an operation of torch on the values, its result on the device that torch would leave it on."""
    given = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
    refuse_mixing(function, args, given)
    there = any(isinstance(x, There) for x in (given[1:] if function is aten.to.other else given))
    devices = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.device)]
    if devices:
        there = devices[0].type == NAME
    if "pin_memory" in kwargs:
        kwargs["pin_memory"] = False
    inner = tree_map(_here, (args, kwargs))
    found = function(*inner[0], **inner[1])
    if function is aten._local_scalar_dense.default:
        return found
    if function._schema.name.endswith("_") and not function._schema.name.endswith("__"):
        return args[0]  # changed in place
    known = {id(x.here): x for x in given if isinstance(x, There)}
    return tree_map(lambda x: known.get(id(x), There(x)) if isinstance(x, Tensor) and there else x, found)


def _here(x: Any) -> Any:
    """Return what an argument is on the CPU."""
    if isinstance(x, torch.device):
        return torch.device("cpu")
    return x.here if isinstance(x, There) else x


def refuse_mixing(function: Any, args: Any, given: list[Tensor]) -> None:
    """Raise RuntimeError where an operation is given tensors of both devices; numbers, of no dimension, may."""
    if function in INDEXING:
        given = [args[0], *tree_leaves(args[2:3])]
        if not isinstance(args[0], There) and any(isinstance(x, There) for x in tree_leaves(args[1])):
            raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor (cpu)")
    places = {x.device.type for x in given if isinstance(x, Tensor) and x.dim()}
    if function not in MIXING and len(places) > 1:
        raise RuntimeError(f"Expected all tensors to be on the same device, but {function} was given {sorted(places)}")


class Factories(TorchDispatchMode):
    """Make the tensors that are asked for on the device."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if any(isinstance(x, torch.device) and x.type == NAME for x in tree_leaves((args, kwargs))):
            return run(function, args, kwargs)
        return function(*args, **kwargs)


@contextmanager
def pretended(emulator: Emulator) -> Iterator[torch.device]:
    """Pretend inside that there is a device, whose kernels `emulator` runs; yield it."""

    def launch(features: int, kernel: str, blocks: int, *arguments: Any) -> None:
        tensors = tree_leaves([list(a) if isinstance(a, tuple) else a for a in arguments])
        outside = [x.shape for x in tensors if isinstance(x, Tensor) and not isinstance(x, There)]
        assert not outside, f"{kernel} was given the address of tensors in the host's memory: {outside}"
        emulator(
            features, kernel, blocks, *(tuple(map(_here, a)) if isinstance(a, tuple) else _here(a) for a in arguments)
        )

    with pytest.MonkeyPatch.context() as patch, Factories():
        patch.setattr(cuda_launch, "launcher_for", lambda device: launch)
        patch.setattr(cuda_launch, "this_device", lambda: DEVICE)
        yield DEVICE
