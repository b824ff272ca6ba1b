"""Align two RGB-D images directly: Gauss–Newton on SE(3), coarse to fine, gray and depth residuals together.

The reference may be a rendered map (tracking) or the previous frame (odometry). One render and a dozen steps of 0.1 ms
replace dozens of renders. It runs where the images are: on the CPU, or on a CUDA device.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import BackendError
from sigmasplat.fit.interface import AlignRules, ImageKernels, LevelPlanes
from sigmasplat.fit.pyramid import LEVELS, Pyramid
from sigmasplat.model import se3
from sigmasplat.types import Matrix

HUBER_GRAY = (0.02, 0.05, 0.1, 0.2)
"""Width of the gray residual's quadratic part, from the finest level up: far from the solution all residuals are
large."""
HUBER_DEPTH_RELATIVE = (0.003, 0.006, 0.012, 0.05)
"""The same for depth, times z² (m); the finest is a structured-light sensor's noise (Khoshelham & Elberink 2012)."""
DEPTH_GATES_M = (0.1, 0.3, 0.8, 2.0)
"""Larger depth residuals belong to other surfaces; from the finest level up."""
MIN_PIXELS = 60
DEGENERATE = 1e-5
"""A direction with less than this share of the best one's information is undetermined."""
UNKNOWN_M = 1.0
"""Standard deviation given to such a direction, metres (of shift at the usual depth)."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """T_live_reference; agreement: share of overlapping pixels whose depths agree; overlap: share of reference pixels
    that land on a live reading; degenerate: number of undetermined directions of motion; cost per pixel;
    steps taken; depth_m: mean depth of the reference."""

    T_live_reference: Matrix
    agreement: float
    overlap: float
    degenerate: int
    cost: float
    steps: int
    pair: "Pair"
    depth_m: float

    @cached_property
    def covariance(self) -> Matrix:
        """Estimate the covariance [6, 6] of the left twist (ρ, φ), m and rad, on first access; costs as much as 13
        steps.

        D⁻¹ S D⁻ᵀ: S sums outer products of the gradient cell by cell, as residuals of neighbouring pixels are
        correlated (cluster-robust sandwich estimator, Liang & Zeger 1986); D is the measured change of the gradient
        within half a pixel, as H, built of noisy image gradients, is several times too steep. A degenerate direction
        has `UNKNOWN_M` of deviation. Infinite without common pixels.
        """
        half_rad = 0.5 / self.pair.reference.cameras[0].fx
        steps = np.repeat([half_rad * self.depth_m, half_rad], 3)
        aside = [se3.exp(sign * twist) @ self.T_live_reference for twist in np.diag(steps) for sign in (1.0, -1.0)]
        n, *around = normal_equations(self.pair.kernels, self.pair.level(0), [self.T_live_reference, *aside])
        if n.sums[1] < MIN_PIXELS:
            return np.diag(np.full(6, np.inf))
        directions, decided = _axes(n, self.depth_m)
        basis, unknown = directions[:, decided], directions[:, ~decided]
        slope = basis.T @ _slope(around, steps) @ basis
        bread = basis @ np.linalg.inv(slope) @ basis.T
        return np.asarray(bread @ n.S @ bread.T + UNKNOWN_M**2 * unknown @ unknown.T)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images to align, and how much gray counts against depth."""

    reference: Pyramid
    live: Pyramid
    weight_color: float

    @property
    def kernels(self) -> ImageKernels:
        """Return what aligns the two."""
        return self.reference.kernels

    def level(self, k: int) -> LevelPlanes:
        """Lay one level of the pyramids out for the kernels."""
        r, live, width = self.reference, self.live, min(k, LEVELS - 1)
        c = r.cameras[k]
        options = [self.weight_color, 1.0 - self.weight_color]
        options += [HUBER_GRAY[width], HUBER_DEPTH_RELATIVE[width], DEPTH_GATES_M[width]]
        return LevelPlanes(
            r.gray[k], r.depth[k], r.weight[k], r.weight_depth[k], live.gray[k], live.depth[k],
            [c.fx, c.fy, c.cx, c.cy], options,
        )  # fmt: skip


@dataclass(eq=False)
class Normal:
    """The normal equations of one step, as `_core.align_step` writes them: information H and gradient b by a left
    twist, S = Σ b_c b_cᵀ over cells c of the image."""

    H: Matrix
    b: Matrix
    S: Matrix
    sums: Matrix
    """Weighted cost, pixels used, pixels in view with depth, pixels agreeing in depth."""


def normal_equations(kernels: ImageKernels, level: LevelPlanes, motions: Sequence[Matrix]) -> list[Normal]:
    """Linearise the residuals of a level at some motions T_live_reference, at most 13."""
    rows = kernels.normal_equations(level, motions)
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
    """Find the motion from the reference to the live image, from a first guess.

    Each level takes up to `iterations` Gauss–Newton steps with Huber weights and ends below `update_stop` (m, rad), or
    when the cost has changed by less than `plateau_stop` of it (0 = off). If the finest level does neither, its best
    iterate is returned. Undetermined directions keep the guess. weight_color in [0, 1] balances gray against depth,
    each in units of its Huber width. Raises BackendError without the compiled kernels, or where only one image is on a
    device.
    """
    if reference.kernels is not live.kernels:
        raise BackendError("the two images to align are on different devices; make both for the same view")
    rules = AlignRules(iterations, update_stop, plateau_stop, DEGENERATE, MIN_PIXELS)
    pair = Pair(reference, live, weight_color)
    levels = [pair.level(k) for k in range(len(reference.cameras))]
    found = pair.kernels.align(levels, reference.readings, T_live_reference, rules)
    return Alignment(
        se3.orthonormalise(found.T),
        agreement=float(found.sums[3] / max(found.sums[2], 1.0)),
        overlap=float(found.sums[2] / max(found.readings, 1.0)),
        degenerate=found.degenerate,
        cost=float(found.sums[0] / max(found.sums[1], 1.0)),
        steps=found.steps,
        pair=pair,
        depth_m=found.depth_m,
    )


def _axes(n: Normal, depth_m: float) -> tuple[Matrix, NDArray[np.bool_]]:
    """Split the information into principal directions, rotations measured by the shift they cause at the mean depth.

    Returns (directions as columns [6, 6], which ones the images decide [6]) (Zhang et al. 2016).
    """
    unit = np.repeat([1.0, 1.0 / depth_m], 3)
    eigenvalues, directions = np.linalg.eigh(n.H * np.outer(unit, unit))
    return directions * unit[:, None], eigenvalues > DEGENERATE * max(eigenvalues[-1], 1e-300)


def _slope(around: Sequence[Normal], steps: Matrix) -> Matrix:
    """Differentiate the gradient by the twist, by central differences: steps [6] ahead and behind; symmetric."""
    pulls = np.stack([n.b for n in around])
    D = ((pulls[::2] - pulls[1::2]) / (2.0 * steps[:, None])).T
    return np.asarray(0.5 * (D + D.T))


def _symmetric(upper: Matrix) -> Matrix:
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = upper
    return full + np.triu(full, 1).T
