"""List the loss terms that the compiled kernels compute, by backend. All other terms are computed in torch."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.fit.interface import Weights


@dataclass(frozen=True)
class FusedTerm:
    """A term's index in the weights array of the kernels (None: it has its own kernel), and the backends whose kernels
    compute it."""

    index: int | None
    backends: frozenset[str]


COMPILED = frozenset({"cpu", "cuda"})
PIXEL_TERMS = {
    "l1": FusedTerm(0, COMPILED),
    "depth": FusedTerm(1, COMPILED),
    "nll_color": FusedTerm(2, COMPILED),
    "nll_depth": FusedTerm(3, COMPILED),
    "median_depth": FusedTerm(4, COMPILED),
    "moment": FusedTerm(5, COMPILED),
    "mean_depth": FusedTerm(6, COMPILED),
}
"""Terms per pixel, in the order of `LossWeights` (native/kernels.h, native/cuda/fit.cu)."""
WINDOW_TERMS = {"ssim": FusedTerm(None, COMPILED)}
SHAPE_TERMS = {"isotropy": FusedTerm(0, COMPILED), "isotropy_ratio": FusedTerm(1, COMPILED)}
"""Terms of the splats instead of an image, in the order of `StepOptions` (native/kernels.h)."""
VARIANCE_TERMS = ("nll_color", "nll_depth")
"""Terms that need the variance planes."""


def fused_terms(backend: str) -> frozenset[str]:
    """Return the terms that a backend's kernels compute."""
    table = PIXEL_TERMS | WINDOW_TERMS | SHAPE_TERMS
    return frozenset(name for name, fused in table.items() if backend in fused.backends)


def kernel_weights(table: dict[str, FusedTerm], weights: Weights, backend: str) -> NDArray[np.float64]:
    """Return the weights of a table's terms as the array that a backend's kernels take."""
    own = {name: fused.index for name, fused in table.items() if backend in fused.backends and fused.index is not None}
    laid_out = np.zeros(1 + max(own.values()))
    for name, index in own.items():
        laid_out[index] = weights.get(name, 0.0)
    return laid_out


def pixel_weights(weights: Weights, backend: str, variance: bool) -> NDArray[np.float64]:
    """Return the weights of the pixel terms as an array; without variance planes, terms that need them get weight 0."""
    known = weights if variance else {n: w for n, w in weights.items() if n not in VARIANCE_TERMS}
    return kernel_weights(PIXEL_TERMS, known, backend)
