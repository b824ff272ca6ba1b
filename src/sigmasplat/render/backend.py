"""Choose what computes: the kernels of the device that the tensors lie on, or their definition in plain torch."""

from types import ModuleType

import torch

from sigmasplat import env
from sigmasplat.errors import BackendError
from sigmasplat.render import reference

BACKENDS = ("auto", "cpu", "cuda", "reference")


def is_cuda(kernels: ModuleType) -> bool:
    """Tell whether `backend_module` returned the kernels that want tensors on a CUDA device."""
    return kernels.__name__ == "sigmasplat.render.cuda"


def backend_module(name: str, device: torch.device | None = None) -> ModuleType:
    """Return the module whose `project` and `blend` do the work; "auto" is SIGMASPLAT_BACKEND's, else the kernels.

    device: where the tensors lie; those of a CUDA device are for `cuda` unless another is named. Raises BackendError if
    it is unknown or not built.
    """
    if name == "auto":
        name = env.switches().backend
    if name == "reference":
        return reference
    if name not in BACKENDS:
        raise BackendError(f"unknown backend {name!r} (known: {', '.join(BACKENDS)})")
    if name == "cuda" or (name == "auto" and device is not None and device.type == "cuda"):
        from sigmasplat.render import cuda

        return cuda
    try:
        from sigmasplat.render import cpu
    except ImportError as problem:
        raise BackendError(
            f"the compiled kernels cannot be loaded ({problem}); reinstall with `pip install .`, or use the slow "
            "plain-torch backend: --set backend=reference --set tracking.method=adam"
        ) from problem
    return cpu
