"""Make `project` and `blend` of a backend from its autograd functions, float32.

Arguments, results and docstrings are those of the definitions in `reference`.
"""

from collections.abc import Callable
from functools import wraps
from inspect import signature
from typing import ParamSpec

import torch

from sigmasplat.render.reference.operators import Blended, Projection

Inputs = ParamSpec("Inputs")


def project_with(
    kernel: type[torch.autograd.Function], definition: Callable[Inputs, Projection]
) -> Callable[Inputs, Projection]:
    """Return a `project` that runs the kernel; the pose may be float64."""
    arguments = signature(definition)

    @wraps(definition)
    def project(*args: Inputs.args, **kwargs: Inputs.kwargs) -> Projection:
        return Projection(*kernel.apply(*arguments.bind(*args, **kwargs).args))  # type: ignore[no-untyped-call]

    return project


def blend_with(
    kernel: type[torch.autograd.Function], features_at_once: int, definition: Callable[Inputs, Blended]
) -> Callable[Inputs, Blended]:
    """Return a `blend` of any number of features that runs the kernel once for every `features_at_once` of them.

    The first run makes every map; the other runs make only the sums of their features.
    """
    arguments = signature(definition)

    @wraps(definition)
    def blend(*args: Inputs.args, **kwargs: Inputs.kwargs) -> Blended:
        *splats, features, ref_depth, camera, options = arguments.bind(*args, **kwargs).args
        groups = torch.split(features, features_at_once, dim=1)
        first = kernel.apply(*splats, groups[0], ref_depth, camera, options)  # type: ignore[no-untyped-call]
        more = [kernel.apply(*splats, g, None, camera, options)[0] for g in groups[1:]]  # type: ignore[no-untyped-call]
        return Blended(torch.cat([first[0], *more], -1) if more else first[0], *first[1:])

    return blend
