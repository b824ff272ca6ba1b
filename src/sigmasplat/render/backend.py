"""Choose the renderer: the kernels of a device, or their definition in plain torch.

Only this module and the table of the fits (fit/backends.py) choose by device. The table uses the backend name that a
view gets here.
"""

import warnings
from dataclasses import replace
from types import ModuleType

import torch

from sigmasplat import env
from sigmasplat.config import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.errors import BackendError
from sigmasplat.render.view import View

BACKENDS = ("auto", "cpu", "cuda", "reference")


def backend_name(asked: str, device: torch.device | None = None) -> str:
    """Return "cpu", "cuda" or "reference" for a requested backend.

    "auto" means the value of SIGMASPLAT_BACKEND if it is set, else the kernels of the device that holds the tensors,
    else those of the CPU. Raises BackendError if the name is unknown.
    """
    name = env.switches().backend if asked == "auto" else asked
    if name not in BACKENDS:
        raise BackendError(f"unknown backend {name!r} (known: {', '.join(BACKENDS)})")
    if name == "auto":
        return "cuda" if device is not None and device.type == "cuda" else "cpu"
    return name


def backend_module(asked: str, device: torch.device | None = None) -> ModuleType:
    """Return the module with `project` and `blend` of the backend that `backend_name` returns.

    Raises BackendError if it is unknown or not built.
    """
    name = backend_name(asked, device)
    if name == "reference":
        from sigmasplat.render.reference import operators as reference

        return reference
    if name == "cuda":
        from sigmasplat.render.cuda import operators as cuda

        return cuda
    try:
        from sigmasplat.render.cpu import operators as cpu
    except ImportError as problem:
        raise BackendError(
            f"the compiled kernels cannot be loaded ({problem}); reinstall with `pip install .`, or use the slow "
            "plain-torch backend: --set backend=reference --set tracking.method=adam"
        ) from problem
    return cpu


def options_on(backend: str, options: RenderConfig) -> RenderConfig:
    """Return the options that a backend (by name) renders with: CUDA has only `render.depth=center`, and warns."""
    if backend != "cuda" or options.depth == "center":
        return options
    warnings.warn("render.depth=ray does not run on CUDA yet; depth is that of the splats' centres", stacklevel=3)
    return replace(options, depth="center")


def make_view(backend: str, camera: Camera, options: RenderConfig, variance: bool = True) -> View:
    """Make a view on a backend by name (one of `BACKENDS`). Raises BackendError as `backend_module` does."""
    backend_module(backend)  # raises BackendError if the kernels are missing
    name = backend_name(backend)
    if name == "reference":
        from sigmasplat.render.reference.view import ReferenceView

        return ReferenceView(camera, options, variance)
    if name == "cuda":
        from sigmasplat.render.cuda.view import CudaView

        return CudaView(camera, options_on(name, options), variance)
    from sigmasplat.render.cpu.view import CpuView

    return CpuView(camera, options, variance)
