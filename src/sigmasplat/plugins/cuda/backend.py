"""Offer CUDA as a backend: how it renders, and what it does of the fits."""

from dataclasses import replace
from types import ModuleType

from sigmasplat.api import TORCH, Backend, DeviceFits, reference_maps
from sigmasplat.plugins.cuda import descent, images, launch
from sigmasplat.plugins.cuda.mapping_step import CudaStep, CudaViewDependentStep, to_host
from sigmasplat.plugins.cuda.view import CudaView


def _operators() -> ModuleType:
    from sigmasplat.plugins.cuda import operators

    return operators


def _fits() -> DeviceFits:
    return replace(
        TORCH,
        mapping_step=CudaStep,
        view_dependent_step=CudaViewDependentStep,
        to_host=to_host,
        descend=descent.descend_on_device,
        reference_maps=reference_maps,
        live_planes=images.live_planes,
        images=images.CUDA_IMAGES,
    )


PLUGIN = Backend(
    "cuda", _operators, lambda camera, options, variance: CudaView(camera, options, variance), _fits,
    lambda: launch.this_device(),
)  # fmt: skip
