"""Align two RGB-D images directly: Gauss–Newton on SE(3), coarse to fine, gray and depth residuals together.

The reference may be a rendered map (tracking) or the previous frame (odometry). One render and a dozen steps of 0.1 ms
replace dozens of renders. It is done where the images lie: on the CPU, or on a CUDA device.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.errors import BackendError
from sigmasplat.fit.cuda import align as cuda_align
from sigmasplat.fit.cuda.align import CudaLevel, Descent, Rules
from sigmasplat.fit.pyramid import LEVELS, Pyramid
from sigmasplat.model import se3
from sigmasplat.render.backend import backend_module
from sigmasplat.types import Matrix

if TYPE_CHECKING:
    from sigmasplat.native import _core

    Level = _core.Level | CudaLevel


HUBER_GRAY = (0.02, 0.05, 0.1, 0.2)
"""Width of the gray residual's quadratic part, from the finest level up: far from the answer all of them are large."""
HUBER_DEPTH_RELATIVE = (0.003, 0.006, 0.012, 0.05)
"""The same for depth, times z² (m): from a structured-light sensor's noise (Khoshelham & Elberink 2012) up."""
DEPTH_GATES_M = (0.1, 0.3, 0.8, 2.0)
"""Depth residuals beyond are other surfaces; from the finest level up."""
MIN_PIXELS = 60
DEGENERATE = 1e-5
"""A direction with less than this share of the best one's information is not decided by the images."""
UNKNOWN_M = 1.0
"""Standard deviation given to such a direction, metres (of shift at the usual depth)."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """T_live_reference; agreement: share of overlapping pixels whose depths agree; overlap: share of reference pixels
    that land on a live reading; degenerate: how many directions of motion the images say nothing about; cost per pixel;
    steps taken."""

    T_live_reference: Matrix
    agreement: float
    overlap: float
    degenerate: int
    cost: float
    steps: int
    pair: "Pair"

    @cached_property
    def covariance(self) -> Matrix:
        """Estimate the covariance [6, 6] of the left twist (ρ, φ), m and rad, when asked for: 13 steps' time.

        D⁻¹ S D⁻ᵀ: S sums the pull's outer products cell by cell, for residuals of neighbouring pixels err together
        (cluster-robust sandwich estimator, Liang & Zeger 1986); D is how the pull really changes within half a pixel,
        for H, built of noisy image gradients, is several times too steep. A degenerate direction has `UNKNOWN_M` of
        deviation. Infinite where nothing was in common.
        """
        half_rad = 0.5 / self.pair.reference.cameras[0].fx
        steps = np.repeat([half_rad * self.pair.depth_m, half_rad], 3)
        aside = [se3.exp(sign * twist) @ self.T_live_reference for twist in np.diag(steps) for sign in (1.0, -1.0)]
        n, *around = normal_equations(self.pair.level(0), [self.T_live_reference, *aside])
        if n.sums[1] < MIN_PIXELS:
            return np.diag(np.full(6, np.inf))
        directions, decided = _axes(n, self.pair.depth_m)
        basis, unknown = directions[:, decided], directions[:, ~decided]
        slope = basis.T @ _slope(around, steps) @ basis
        bread = basis @ np.linalg.inv(slope) @ basis.T
        return np.asarray(bread @ n.S @ bread.T + UNKNOWN_M**2 * unknown @ unknown.T)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images to align and how gray weighs against depth; depth_m: mean depth of the reference."""

    reference: Pyramid
    live: Pyramid
    weight_color: float
    depth_m: float

    def level(self, k: int) -> "Level":
        """Lay one level of the pyramids out for the kernels."""
        laid_out = _laid_out(self.reference, self.live, self.weight_color, k)
        if self.reference.on_device:
            return CudaLevel(*laid_out)
        from sigmasplat.native import _core

        return _core.Level(*laid_out)


@dataclass(eq=False)
class Normal:
    """The normal equations of one step, as `_core.align_step` writes them: information H and pull b of a left twist,
    S = Σ b_c b_cᵀ over cells c of the image."""

    H: Matrix
    b: Matrix
    S: Matrix
    sums: Matrix
    """Weighted cost, pixels used, pixels in view with depth, pixels agreeing in depth."""


def normal_equations(level: "Level", motions: Sequence[Matrix]) -> list[Normal]:
    """Linearise the residuals of a level at each of some motions T_live_reference, at most `cuda_align.MOTIONS`."""
    rows = np.zeros((len(motions), cuda_align.NORMAL_TERMS))
    if isinstance(level, CudaLevel):
        rows = level.normal_equations(np.stack(motions))
    else:
        from sigmasplat.native import _core

        for row, T in zip(rows, motions, strict=True):
            _core.align_step(level, T, row[:21], row[21:27], row[31:], row[27:31])
    return [Normal(_symmetric(row[:21]), row[21:27], _symmetric(row[31:]), row[27:31]) for row in rows]


def align(
    reference: Pyramid,
    live: Pyramid,
    T_live_reference: Matrix,
    iterations: int = 15,
    weight_color: float = 0.5,
    update_stop: float = 1e-4,
    plateau_stop: float = 0.0,
) -> Alignment:
    """Find the motion that lays the reference onto the live image, from a first guess.

    Each level takes up to `iterations` Gauss–Newton steps with Huber weights and ends below `update_stop` (m, rad), or
    when the cost has changed by less than `plateau_stop` of it (0 = off). If the finest does neither its best iterate
    stands. Directions the images say nothing about keep the guess.
    weight_color in [0, 1] balances gray against depth, each in units of its Huber width.
    Raises BackendError without the compiled kernels, or where one image lies on a device and the other does not.
    """
    if reference.on_device != live.on_device:
        raise BackendError("one image to align lies on a device, the other does not; make both for the same view")
    rules, readings = Rules(iterations, update_stop, plateau_stop, DEGENERATE, MIN_PIXELS), reference.readings
    levels = [_laid_out(reference, live, weight_color, k) for k in range(len(reference.cameras))]
    if isinstance(readings, Tensor):
        found = cuda_align.descend([CudaLevel(*level) for level in levels], readings, T_live_reference, rules)
    else:
        found = _descend(levels, readings, T_live_reference, rules)
    return Alignment(
        se3.orthonormalise(found.T),
        agreement=float(found.sums[3] / max(found.sums[2], 1.0)),
        overlap=float(found.sums[2] / max(found.readings, 1.0)),
        degenerate=found.degenerate,
        cost=float(found.sums[0] / max(found.sums[1], 1.0)),
        steps=found.steps,
        pair=Pair(reference, live, weight_color, found.depth_m),
    )


def _laid_out(reference: Pyramid, live: Pyramid, weight_color: float, k: int) -> tuple[Any, ...]:
    """Return what makes a `Level`: planes of one level, intrinsics, and how residuals are weighed."""
    c, width = reference.cameras[k], min(k, LEVELS - 1)
    numbers = [weight_color, 1.0 - weight_color]
    numbers += [HUBER_GRAY[width], HUBER_DEPTH_RELATIVE[width], DEPTH_GATES_M[width]]
    return (
        reference.gray[k], reference.depth[k], reference.weight[k], reference.weight_depth[k],
        live.gray[k], live.depth[k], [c.fx, c.fy, c.cx, c.cy], numbers,
    )  # fmt: skip


def _descend(levels: Sequence[tuple[Any, ...]], readings: Matrix, guess: Matrix, rules: Rules) -> Descent:
    """Do on the CPU what `cuda_align.descend` does on a device."""
    backend_module("cpu")  # refuses in one line where the kernels are not built
    from sigmasplat.native import _core

    (depth_m, n), T, sums = readings.tolist(), np.array(guess, np.float64), np.zeros(4)
    r = rules
    steps, degenerate = _core.align_images(
        [_core.Level(*level) for level in levels], r.iterations, r.update_stop, r.plateau_stop, depth_m,
        r.degenerate_share, r.min_pixels, T, sums,
    )  # fmt: skip
    return Descent(T, sums, steps, degenerate, depth_m, n)


def _axes(n: Normal, depth_m: float) -> tuple[Matrix, NDArray[np.bool_]]:
    """Split the information into principal directions, rotations measured by the shift they make at the usual depth.

    Returns (directions as columns [6, 6], which ones the images decide [6]) (Zhang et al. 2016).
    """
    unit = np.repeat([1.0, 1.0 / depth_m], 3)
    eigenvalues, directions = np.linalg.eigh(n.H * np.outer(unit, unit))
    return directions * unit[:, None], eigenvalues > DEGENERATE * max(eigenvalues[-1], 1e-300)


def _slope(around: Sequence[Normal], steps: Matrix) -> Matrix:
    """Differentiate the pull by the twist, by central differences: steps [6] ahead and behind; symmetric."""
    pulls = np.stack([n.b for n in around])
    D = ((pulls[::2] - pulls[1::2]) / (2.0 * steps[:, None])).T
    return np.asarray(0.5 * (D + D.T))


def _symmetric(upper: Matrix) -> Matrix:
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = upper
    return full + np.triu(full, 1).T
