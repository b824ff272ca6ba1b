"""List what each backend offers to the fits. In `fit` and the layers above, only this module chooses by device.
Plug-ins add other devices."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from torch import Tensor

from sigmasplat.fit import adam, cpu, tracking_loss
from sigmasplat.fit.descent import descend
from sigmasplat.fit.interface import DeviceFits, MappingStep, Twist, Weights
from sigmasplat.fit.losses import FUSED_TERMS, maps_of
from sigmasplat.fit.mapping_step import OwnTermsStep, TorchStep, ViewDependentStep
from sigmasplat.fit.tracking_loss import reference_arrays
from sigmasplat.registry import Backend, named
from sigmasplat.render.view import View
from sigmasplat.types import Matrix


def _on_host(twists: Sequence[Twist], costs: Sequence[float | Tensor]) -> tuple[list[Matrix], list[float]]:
    return [np.asarray(twist) for twist in twists], [float(cost) for cost in costs]


TORCH = DeviceFits(
    mapping_step=TorchStep, view_dependent_step=ViewDependentStep, settle=adam.settle, to_host=_on_host,
    tracking_loss=tracking_loss.tracking_gradient, descend=descend, reference_maps=reference_arrays,
    live_planes=cpu.live_planes, images=cpu.CPU_IMAGES,
)  # fmt: skip
CPU = replace(
    TORCH, mapping_step=cpu.CompiledStep, view_dependent_step=cpu.CompiledViewDependentStep, settle=cpu.settle,
    tracking_loss=cpu.tracking_gradient, descend=partial(descend, tracking_loss=cpu.tracking_gradient),
    reference_maps=cpu.reference_maps,
)  # fmt: skip
OWN = {"reference": TORCH, "cpu": CPU}


def fits_of(on: Any) -> DeviceFits:
    """Return the functions that the backend (`on.backend`) of a view or a pyramid offers to the fits."""
    return OWN[on.backend] if on.backend in OWN else _added(on.backend)


@cache
def _added(name: str) -> DeviceFits:
    """Return what the backend of a plug-in offers."""
    fits: DeviceFits = named((Backend,), name).fits()
    return fits


def step_for(view: View, weights: Weights, degree: int) -> MappingStep:
    """Make the step that fits a field on a view; degree: of view-dependent colour.

    The device's kernels compute the loss terms that they support; autograd computes the others.
    """
    own = frozenset(name for name, weight in weights.items() if weight) - FUSED_TERMS
    of_scales = any("scales" in maps_of(name) for name in own)
    fits = TORCH if of_scales else fits_of(view)  # the kernels step splats in the pass that makes their gradient
    step = fits.mapping_step(view)
    if own and fits is not TORCH:
        step = OwnTermsStep(step, own)
    return fits.view_dependent_step(step, degree) if degree else step
