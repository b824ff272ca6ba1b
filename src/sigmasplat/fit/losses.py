"""Define the loss terms: each is a function of the maps that its parameters name.

`@term` registers a function as a term. The function's name is the term's name, to which a weight is given; its
parameters without a default are the maps it takes: `scales` alone, or maps of the image. `total` passes each term its
maps by name, so a new term needs one function and one weight.

Maps of the image: color, color_target [H, W, 3] in [0, 1]; depth D̂ = Σwz, depth_target [H, W] m; alpha A = Σw [H, W];
variance [H, W, 3] (V, VarSplat §1); moment [H, W] m² (U, CG-SLAM eq. 10); median_depth [H, W] m, 0 = none (CG-SLAM
eq. 8); valid [H, W] bool, pixels with a depth reading; scales [N, 3] m.

Every image term is a mean over valid pixels (and channels), except SSIM, which is a mean over all pixels of the masked
images. Without valid pixels a term is 0 with zero gradient, never NaN.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from inspect import signature

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv2d

from sigmasplat.errors import ConfigError

TERMS: dict[str, Callable[..., Tensor]] = {}
IMAGE_MAPS = frozenset(
    ("color", "color_target", "depth", "depth_target", "alpha", "variance", "moment", "median_depth", "valid")
)
NLL_EPS = 1e-6
COVERED = 0.5
"""Above this alpha a pixel has a depth: D̂/A."""
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def term(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Register a loss term under its function's name. Raises ConfigError if it takes a map that does not exist."""
    maps = _maps_of(function)
    if maps != {"scales"} and (unknown := sorted(maps - IMAGE_MAPS)):
        known = ", ".join(sorted(IMAGE_MAPS))
        raise ConfigError(
            f"loss term {function.__name__!r} takes {', '.join(unknown)}; known: {known}, or scales alone"
        )
    TERMS[function.__name__] = function
    return function


@cache
def _maps_of(function: Callable[..., Tensor]) -> frozenset[str]:
    return frozenset(name for name, given in signature(function).parameters.items() if given.default is given.empty)


def maps_of(name: str) -> frozenset[str]:
    """Return the names of the maps that a term takes. Raises ConfigError if there is no such term."""
    if name not in TERMS:
        raise ConfigError(f"unknown loss term {name!r} (known: {', '.join(TERMS)})")
    return _maps_of(TERMS[name])


def take(weights: Mapping[str, float], map_name: str) -> bool:
    """Return whether a term of nonzero weight takes this map."""
    return any(weight and map_name in maps_of(name) for name, weight in weights.items())


def total(weights: Mapping[str, float], maps: Mapping[str, Tensor]) -> Tensor:
    """Return the sum of weight × term, a scalar []. A term of weight 0 is not computed, and its maps may be missing.

    Raises ConfigError if a weight names no term, KeyError if a term's map is missing.
    """
    loss = torch.zeros(())
    for name, weight in weights.items():
        taken = maps_of(name)
        if weight != 0.0:
            loss = loss + weight * TERMS[name](**{m: maps[m] for m in taken})
    return loss


def masked(values: Tensor, valid: Tensor, fill: float = 0.0) -> Tensor:
    """Replace values [H, W] or [H, W, C] by `fill` where valid [H, W] is false. NaN at these pixels affects neither the
    result nor the gradient."""
    return torch.where(valid if values.ndim == valid.ndim else valid[..., None], values, fill)


def mean_over(values: Tensor, valid: Tensor) -> Tensor:
    """Return the mean of values [H, W] or [H, W, C] over valid [H, W] and channels, in their unit []; 0 if none is
    valid."""
    channels = values.numel() // max(valid.numel(), 1)
    return masked(values, valid).sum() / (valid.sum() * channels).clamp(min=1)


@term
def l1(color: Tensor, color_target: Tensor, valid: Tensor) -> Tensor:
    """Return the mean of |Ĉ − C| of colours [H, W, 3] in [0, 1] over valid [H, W] × 3 (VarSplat §2, L_color)."""
    return mean_over(masked(color - color_target, valid).abs(), valid)


@term
def ssim(color: Tensor, color_target: Tensor, valid: Tensor) -> Tensor:
    """Return 1 − mean SSIM of colours [H, W, 3]. Both are 0 outside valid [H, W] and outside the image (VarSplat §2).

    Windows without valid pixels are equal in both images (SSIM 1) and count in the mean, as in the released code.
    """
    return 1.0 - ssim_map(masked(color, valid), masked(color_target, valid)).mean()


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Return the SSIM of two images [H, W, C] at every window, [H, W, C] in [−1, 1] (11×11 Gaussian, σ 1.5, zero
    padding)."""
    x, y = a.movedim(-1, 0), b.movedim(-1, 0)
    mx, my, xx, yy, xy = _blur(torch.cat([x, y, x * x, y * y, x * y])).chunk(5)
    var_x, var_y, cov = xx - mx * mx, yy - my * my, xy - mx * my
    luminance = (2 * mx * my + SSIM_C1) / (mx * mx + my * my + SSIM_C1)
    structure = (2 * cov + SSIM_C2) / (var_x + var_y + SSIM_C2)
    return (luminance * structure).movedim(0, -1)


def _blur(planes: Tensor) -> Tensor:
    """Convolve planes [C, H, W] with a normalised 11×11 Gaussian of σ 1.5 px, with zero padding."""
    taps = torch.arange(-5, 6, dtype=planes.dtype, device=planes.device)
    kernel = torch.exp(-(taps**2) / (2 * 1.5**2))
    kernel = kernel / kernel.sum()
    rows = conv2d(planes[:, None], kernel.reshape(1, 1, 1, 11), padding=(0, 5))
    return conv2d(rows, kernel.reshape(1, 1, 11, 1), padding=(5, 0))[:, 0]


@term
def depth(depth: Tensor, depth_target: Tensor, valid: Tensor) -> Tensor:
    """Return the mean of |D̂ − D| of depths [H, W] m over valid [H, W] with a reading, m (VarSplat §2, L_depth)."""
    valid = valid & (depth_target > 0)
    return mean_over(masked(depth - depth_target, valid).abs(), valid)


@term
def mean_depth(depth: Tensor, alpha: Tensor, depth_target: Tensor, valid: Tensor) -> Tensor:
    """Return the mean of |D̂/A − D| over valid [H, W] with a reading, m; 0 where the alpha A is at most `COVERED`.

    D̂/A is the mean depth of the splats of a pixel. D̂ alone is too small wherever light passes the map, and a loss on it
    moves splats away from the surface.
    """
    counted = valid & (depth_target > 0) & (alpha > COVERED)
    error = masked(masked(depth, counted) / masked(alpha, counted, fill=1.0) - depth_target, counted)
    return error.abs().sum() / valid.sum().clamp(min=1)


@term
def isotropy(scales: Tensor) -> Tensor:
    """Return the mean of |s_i − mean(s_i)| of scales [N, 3] m, over splats × 3, m (VarSplat §2, L_reg); 0 if N = 0."""
    off = scales - scales.mean(1, keepdim=True)
    return off.abs().sum() / max(off.numel(), 1)


@term
def isotropy_ratio(scales: Tensor) -> Tensor:
    """Return the mean of max(s_i) / min(s_i) − 1 of scales [N, 3] m in view (CG-SLAM eq. 17, ε = 1); 0 if N = 0."""
    return (scales.amax(1) / scales.amin(1) - 1.0).sum() / max(len(scales), 1)


@term
def nll_color(color: Tensor, color_target: Tensor, variance: Tensor, valid: Tensor) -> Tensor:
    """Return the Gaussian NLL of colours [H, W, 3] under V [H, W, 3] (VarSplat §2, L_var).

    The residual has no gradient, V has: it trains σ² and, as V = Σ w (σ² + c²) − Ĉ², also colours, shapes and poses.
    """
    return gaussian_nll(color - color_target, variance, valid)


@term
def nll_depth(depth: Tensor, depth_target: Tensor, variance: Tensor, valid: Tensor) -> Tensor:
    """Return the Gaussian NLL of depths [H, W] m, the same for each channel of V [H, W, 3] (VarSplat §2, L_var)."""
    residual = (depth - depth_target)[..., None].expand_as(variance)
    return gaussian_nll(residual, variance, valid & (depth_target > 0))


def gaussian_nll(residual: Tensor, variance: Tensor, valid: Tensor) -> Tensor:
    """Return the mean of ½ r²/(V+ε) + ½ log(V+ε) over valid [H, W] × C, ε = 1e-6, of detached residuals r and V [H, W,
    C].

    V is clamped at 0 only here; the map itself is not changed.
    """
    r = masked(residual.detach(), valid)
    v = masked(variance, valid, fill=1.0).clamp(min=0.0) + NLL_EPS
    return mean_over(0.5 * r * r / v + 0.5 * v.log(), valid)


@term
def moment(moment: Tensor, valid: Tensor) -> Tensor:
    """Return the mean of |U| of the moment [H, W] m² over valid [H, W], m² (CG-SLAM, L_var)."""
    return mean_over(masked(moment, valid).abs(), valid)


@term
def median_depth(depth: Tensor, median_depth: Tensor, valid: Tensor) -> Tensor:
    """Return the mean of |D̂ − D̂m| of depths [H, W] m over valid [H, W], m; 0 without a median (CG-SLAM eq. 16).

    The median is the depth of the splat at which half of the light is absorbed. Both depths get a gradient.
    """
    return masked((depth - median_depth).abs(), valid & (median_depth > 0)).sum() / valid.sum().clamp(min=1)


PIXEL_TERMS = ("l1", "depth", "nll_color", "nll_depth", "median_depth", "moment", "mean_depth")
"""Terms per pixel that the compiled kernels compute, in the order of `LossWeights` (native/kernels.h,
native/cuda/fit.cu)."""
SHAPE_TERMS = ("isotropy", "isotropy_ratio")
"""Those of the splats instead of an image, in the order of `StepOptions` (native/kernels.h)."""
FUSED_TERMS = frozenset((*PIXEL_TERMS, "ssim", *SHAPE_TERMS))
"""All terms of the compiled kernels. The others are computed in torch."""


def kernel_weights(terms: Sequence[str], weights: Mapping[str, float]) -> NDArray[np.float64]:
    """Return the weights of some terms as the array that the kernels take."""
    return np.array([weights.get(name, 0.0) for name in terms])


def pixel_weights(weights: Mapping[str, float], variance: bool) -> NDArray[np.float64]:
    """Return the weights of the pixel terms as an array; without variance planes, terms that need them get weight 0."""
    known = weights if variance else {n: w for n, w in weights.items() if "variance" not in maps_of(n)}
    return kernel_weights(PIXEL_TERMS, known)
