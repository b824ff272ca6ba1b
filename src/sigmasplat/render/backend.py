"""Choose the renderer: the kernels of a device, or their definition in plain torch.

Only this module and the table of the fits (fit/backends.py) choose by device. The table uses the backend name that a
view gets here. Other devices are plug-ins (`registry.Backend`), CUDA among them.
"""

from functools import cache
from types import ModuleType
from typing import NamedTuple, cast

import torch
from torch import Tensor

from sigmasplat import env
from sigmasplat.config import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField, Rows
from sigmasplat.errors import BackendError
from sigmasplat.registry import Backend, named, rows
from sigmasplat.render import cpu, reference
from sigmasplat.render.self_test import self_test
from sigmasplat.render.view import View

CHANNELS = 3
"""Planes that `gather` sums at once: they use the colour channels."""
OWN = ("cpu", "reference")
"""The backends that are no plug-ins."""


def backend_names() -> list[str]:
    """List the names of all backends."""
    return [*OWN, *(row.name for row in rows(Backend))]


def backend_row(name: str) -> Backend | None:
    """Return the plug-in of a backend by name; None for those of this package's core."""
    return None if name in OWN else cast(Backend, named((Backend,), name))


class Automatic(NamedTuple):
    """What "auto" stands for: the name of a backend, and one line that says why; empty where there is no device."""

    name: str = "cpu"
    why: str = ""


@cache
def automatic() -> Automatic:
    """Return the backend of a device of this machine whose self-test passes, else that of the CPU."""
    tried = Automatic()
    for row in rows(Backend) if torch.cuda.is_available() else ():  # no plug-in is loaded where there is no device
        if row.device is None:
            continue
        try:
            device, found = row.device(), self_test(row.view)
        except BackendError as problem:
            tried = Automatic(why=f"computing on the CPU, because {problem}")
            continue
        if found.ok:
            passed = f"computing on {device}, whose self-test passed; SIGMASPLAT_BACKEND=cpu turns it off"
            return Automatic(row.name, passed)
        tried = Automatic(why=f"computing on the CPU, because the self-test of {device} failed: {found}")
    return tried


def why_of(asked: str) -> str:
    """Return the line of `automatic` if it decides which backend is used for a requested one, else nothing."""
    return automatic().why if asked == env.switches().backend == "auto" else ""


def backend_name(asked: str, device: torch.device | None = None) -> str:
    """Return the name of the backend that is used for a requested one.

    "auto" means the value of SIGMASPLAT_BACKEND if it is set, else the kernels of the device that holds the tensors,
    else what `automatic` finds. Raises BackendError if the name is unknown.
    """
    name = env.switches().backend if asked == "auto" else asked
    if name == "auto":
        return automatic().name if device is None or device.type == "cpu" else device.type
    if name not in OWN and name not in backend_names():
        raise BackendError(f"unknown backend {name!r} (known: auto, {', '.join(backend_names())})")
    return name


def backend_module(asked: str, device: torch.device | None = None) -> ModuleType:
    """Return the module with `project` and `blend` of the backend that `backend_name` returns.

    Raises BackendError if it is unknown.
    """
    name = backend_name(asked, device)
    if row := backend_row(name):
        return row.operators()
    return reference if name == "reference" else cpu


def make_view(backend: str, camera: Camera, options: RenderConfig, variance: bool = True) -> View:
    """Make a view on a backend by name, or "auto". Raises BackendError as `backend_module` does."""
    name = backend_name(backend)
    if row := backend_row(name):
        return row.view(camera, options, variance)
    return (reference.ReferenceView if name == "reference" else cpu.CpuView)(camera, options, variance)


def on_device(field: GaussianField, backend: str) -> GaussianField:
    """Return the parts of a field that a render needs, in memory that the backend can read, without optimiser state."""
    row = backend_row(backend_name(backend, field.params.device))
    if row is None or row.device is None or field.params.device.type != "cpu":
        return field
    device = row.device()
    attributes = {name: Rows(attribute.params.to(device)) for name, attribute in field.attributes.items()}
    return GaussianField(field.params.to(device), attributes=attributes)


def gather(view: View, params: Tensor, planes: Tensor) -> Tensor:
    """Return Σ_p w_ip g_p [N, 3] of three planes g [3, H, W] for the last forward pass of a view, of rows [N, 17];
    all on the view's device.

    The colour of a pixel is linear in the splats' colours, so this is the gradient of the colours if g is the gradient
    of the image. The view's gradient planes of colour are 0 afterwards.
    """
    view.g_sums.zero_()
    view.g_alpha.zero_()
    height, width = planes.shape[-2:]
    view.g_sums[:CHANNELS, :height, :width] = planes
    if isinstance(view, cpu.CpuView):  # its kernels sum without the gradient of the alphas
        sums = view.gather(view.g_sums[:CHANNELS])
        view.g_sums.zero_()
        return sums
    g_params = torch.empty_like(params)
    view.backward(params, g_params)
    view.g_sums.zero_()
    return g_params[:, COLUMNS["colors"]]
