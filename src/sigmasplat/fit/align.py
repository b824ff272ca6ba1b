"""Align two RGB-D images directly: Gauss–Newton on SE(3), coarse to fine, gray and depth residuals together.

The reference may be a rendered map (tracking) or the previous frame (odometry). One render and a dozen steps of 0.1 ms
replace dozens of renders.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sigmasplat.fit.pyramid import LEVELS, Pyramid
from sigmasplat.model import se3
from sigmasplat.render.backend import backend_module

if TYPE_CHECKING:
    from sigmasplat.native import _core

Matrix = NDArray[np.float64]

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
        finest = self.pair.level(0)
        n = normal_equations(finest, self.T_live_reference)
        if n.sums[1] < MIN_PIXELS:
            return np.diag(np.full(6, np.inf))
        directions, decided = _axes(n, self.pair.depth_m)
        basis, unknown = directions[:, decided], directions[:, ~decided]
        slope = basis.T @ self._slope(finest) @ basis
        bread = basis @ np.linalg.inv(slope) @ basis.T
        return np.asarray(bread @ n.S @ bread.T + UNKNOWN_M**2 * unknown @ unknown.T)

    def _slope(self, finest: "_core.Level") -> Matrix:
        """Differentiate the pull by the twist, by central differences of half a pixel; symmetric."""
        half_rad = 0.5 / self.pair.reference.cameras[0].fx
        steps, D = np.repeat([half_rad * self.pair.depth_m, half_rad], 3), np.zeros((6, 6))
        for k, step in enumerate(steps):
            ahead, behind = (
                normal_equations(finest, se3.exp(sign * step * np.eye(6)[k]) @ self.T_live_reference).b
                for sign in (1.0, -1.0)
            )
            D[:, k] = (ahead - behind) / (2.0 * step)
        return 0.5 * (D + D.T)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images to align and how gray weighs against depth; depth_m: mean depth of the reference."""

    reference: Pyramid
    live: Pyramid
    weight_color: float
    depth_m: float

    def level(self, k: int) -> "_core.Level":
        """Lay one level of the pyramids out for the kernels."""
        from sigmasplat.native import _core

        reference, live, width = self.reference, self.live, min(k, LEVELS - 1)
        c = reference.cameras[k]
        numbers = [self.weight_color, 1.0 - self.weight_color]
        numbers += [HUBER_GRAY[width], HUBER_DEPTH_RELATIVE[width], DEPTH_GATES_M[width]]
        return _core.Level(
            reference.gray[k], reference.depth[k], reference.weight[k], reference.weight_depth[k],
            live.gray[k], live.depth[k], [c.fx, c.fy, c.cx, c.cy], numbers,
        )  # fmt: skip


@dataclass(eq=False)
class Normal:
    """The normal equations of one step, as `_core.align_step` writes them: information H and pull b of a left twist,
    S = Σ b_c b_cᵀ over cells c of the image."""

    H: Matrix
    b: Matrix
    S: Matrix
    sums: Matrix
    """Weighted cost, pixels used, pixels in view with depth, pixels agreeing in depth."""


def normal_equations(level: "_core.Level", T_live_reference: Matrix) -> Normal:
    """Linearise the residuals of a level at a motion."""
    from sigmasplat.native import _core

    H, b, S, sums = np.zeros(21), np.zeros(6), np.zeros(21), np.zeros(4)
    _core.align_step(level, T_live_reference, H, b, S, sums)
    return Normal(_symmetric(H), b, _symmetric(S), sums)


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
    Raises BackendError without the compiled kernels.
    """
    backend_module("cpu")  # refuses in one line where the kernels are not built
    from sigmasplat.native import _core

    pair = Pair(reference, live, weight_color, _usual_depth(reference))
    T, sums, levels = np.array(T_live_reference, np.float64), np.zeros(4), range(len(reference.cameras))
    steps, degenerate = _core.align_images(
        [pair.level(k) for k in levels], iterations, update_stop, plateau_stop, pair.depth_m, DEGENERATE, MIN_PIXELS,
        T, sums,
    )  # fmt: skip
    reference_pixels = max(int((reference.depth[0] > 0).sum()), 1)
    return Alignment(
        se3.orthonormalise(T),
        agreement=float(sums[3] / max(sums[2], 1.0)),
        overlap=float(sums[2] / reference_pixels),
        degenerate=degenerate,
        cost=float(sums[0] / max(sums[1], 1.0)),
        steps=steps,
        pair=pair,
    )


def _usual_depth(reference: Pyramid) -> float:
    """Return the mean depth of a reference, metres: what turns a rotation into the shift it makes."""
    coarse = reference.depth[-1]
    read = coarse[coarse > 0]
    return float(read.mean()) if len(read) else 1.0


def _axes(n: Normal, depth_m: float) -> tuple[Matrix, NDArray[np.bool_]]:
    """Split the information into principal directions, rotations measured by the shift they make at the usual depth.

    Returns (directions as columns [6, 6], which ones the images decide [6]) (Zhang et al. 2016).
    """
    unit = np.repeat([1.0, 1.0 / depth_m], 3)
    eigenvalues, directions = np.linalg.eigh(n.H * np.outer(unit, unit))
    return directions * unit[:, None], eigenvalues > DEGENERATE * max(eigenvalues[-1], 1e-300)


def _symmetric(upper: Matrix) -> Matrix:
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = upper
    return full + np.triu(full, 1).T
