"""Align two RGB-D images directly: Gauss–Newton on SE(3), coarse to fine, gray and depth residuals together.

The reference may be a rendered map (tracking) or the previous frame (odometry). One render and a dozen steps of 0.1 ms
replace dozens of renders.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import sobel

from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.render.backend import backend_module

Image = NDArray[np.float32]
Matrix = NDArray[np.float64]

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
LEVELS = 4
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
class Pyramid:
    """Gray in [0, 1] and depth in metres (0 = none) at halving sizes, finest first, with their cameras."""

    gray: list[Image]
    depth: list[Image]
    weight: list[Image | None]
    cameras: list[Camera]

    def weighed(self, weight: Image | None) -> "Pyramid":
        """Return the same images with another weight [H, W] of their pixels."""
        halves = [weight]
        for _ in self.cameras[1:]:
            last = halves[-1]
            halves.append(None if last is None else _quarter(last).mean(0))
        return Pyramid(self.gray, self.depth, halves, self.cameras)

    @staticmethod
    def of(gray: Image, depth_m: Image, camera: Camera, weight: Image | None = None, levels: int = LEVELS) -> "Pyramid":
        """Halve gray [H, W], depth [H, W] and an optional weight [H, W] until `levels` sizes exist."""
        p = Pyramid([np.ascontiguousarray(gray)], [np.ascontiguousarray(depth_m)], [None], [camera])
        for _ in range(levels - 1):
            c = p.cameras[-1]
            if min(c.width, c.height) < 32:
                break
            p.gray.append(_quarter(p.gray[-1]).mean(0))
            p.depth.append(_half_depth(p.depth[-1]))
            # Odd sizes drop their last row or column, so the scale is exactly ½.
            p.cameras.append(
                Camera(c.width // 2, c.height // 2, c.fx / 2, c.fy / 2, (c.cx - 0.5) / 2, (c.cy - 0.5) / 2)
            )
        return p.weighed(weight)


def _quarter(image: Image) -> Image:
    """Stack the four pixels of each 2×2 cell, [4, H/2, W/2]."""
    h, w = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return np.stack([image[0:h:2, 0:w:2], image[0:h:2, 1:w:2], image[1:h:2, 0:w:2], image[1:h:2, 1:w:2]])


def _half_depth(depth: Image) -> Image:
    """Average 2×2 cells that lie on one surface; a cell with a hole or a step has no reading."""
    cells = _quarter(depth)
    near, far = cells.min(0), cells.max(0)
    return np.where((near > 0) & (far - near < 0.05), cells.mean(0), np.float32(0.0))


def gray_of(color: Image) -> Image:
    """Reduce colour [H, W, 3] to luma [H, W]."""
    return np.asarray(color @ LUMA)


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
        n = self.pair.normal_equations(self.T_live_reference, 0)
        if n.sums[1] < MIN_PIXELS:
            return np.diag(np.full(6, np.inf))
        _, directions, decided = _axes(n, self.pair.depth_m)
        basis, unknown = directions[:, decided], directions[:, ~decided]
        slope = basis.T @ self._slope() @ basis
        bread = basis @ np.linalg.inv(slope) @ basis.T
        return np.asarray(bread @ n.S @ bread.T + UNKNOWN_M**2 * unknown @ unknown.T)

    def _slope(self) -> Matrix:
        """Differentiate the pull by the twist, by central differences of half a pixel; symmetric."""
        half_rad = 0.5 / self.pair.reference.cameras[0].fx
        steps, D = np.repeat([half_rad * self.pair.depth_m, half_rad], 3), np.zeros((6, 6))
        for k, step in enumerate(steps):
            ahead, behind = (
                self.pair.normal_equations(se3.exp(sign * step * np.eye(6)[k]) @ self.T_live_reference, 0).b
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

    def normal_equations(self, T_live_reference: Matrix, level: int) -> "Normal":
        """Linearise the residuals at a motion on one level of the pyramids."""
        from sigmasplat.native import _core

        reference, live, width = self.reference, self.live, min(level, LEVELS - 1)
        c, H, b, S, sums = reference.cameras[level], np.zeros(21), np.zeros(6), np.zeros(21), np.zeros(4)
        _core.align_step(
            reference.gray[level], reference.depth[level], reference.weight[level], live.gray[level],
            live.depth[level], [c.fx, c.fy, c.cx, c.cy], self.weight_color, 1.0 - self.weight_color,
            HUBER_GRAY[width], HUBER_DEPTH_RELATIVE[width], DEPTH_GATES_M[width], T_live_reference, H, b, S, sums,
        )  # fmt: skip
        return Normal(_symmetric(H), b, _symmetric(S), sums)


@dataclass(eq=False)
class Normal:
    """The normal equations of one step, as `_core.align_step` writes them: information H and pull b of a left twist,
    S = Σ b_c b_cᵀ over cells c of the image."""

    H: Matrix
    b: Matrix
    S: Matrix
    sums: Matrix
    """Weighted cost, pixels used, pixels in view with depth, pixels agreeing in depth."""

    @property
    def cost(self) -> float:
        return float(self.sums[0] / max(self.sums[1], 1.0))


def align(
    reference: Pyramid,
    live: Pyramid,
    T_live_reference: Matrix,
    iterations: int = 15,
    weight_color: float = 0.5,
    update_stop: float = 1e-4,
) -> Alignment:
    """Find the motion that lays the reference onto the live image, from a first guess.

    Each level takes up to `iterations` Gauss–Newton steps with Huber weights and ends below `update_stop` (m, rad). If
    the finest does not get there its best iterate stands. Directions the images say nothing about keep the guess.
    weight_color in [0, 1] balances gray against depth, each in units of its Huber width.
    Raises BackendError without the compiled kernels.
    """
    backend_module("cpu")  # refuses in one line where the kernels are not built
    pair = Pair(reference, live, weight_color, _usual_depth(reference))
    T, steps = np.array(T_live_reference, np.float64), 0
    for level in reversed(range(len(reference.cameras))):
        best, best_T, settled = None, T, False
        for _ in range(iterations):
            n = pair.normal_equations(T, level)
            steps += 1
            if n.sums[1] < MIN_PIXELS:
                break
            if best is None or n.cost < best.cost:
                best, best_T = n, T
            update, degenerate = _solve(n, pair.depth_m)
            T = se3.exp(update) @ T
            settled = bool(np.abs(update).max() < update_stop)
            if settled:
                break
    last = n if settled or best is None else best
    reference_pixels = max(int((reference.depth[0] > 0).sum()), 1)
    return Alignment(
        se3.orthonormalise(T if settled else best_T),
        agreement=float(last.sums[3] / max(last.sums[2], 1.0)),
        overlap=float(last.sums[2] / reference_pixels),
        degenerate=6 if best is None else degenerate,
        cost=last.cost,
        steps=steps,
        pair=pair,
    )


def _usual_depth(reference: Pyramid) -> float:
    """Return the mean depth of a reference, metres: what turns a rotation into the shift it makes."""
    coarse = reference.depth[-1]
    read = coarse[coarse > 0]
    return float(read.mean()) if len(read) else 1.0


def _axes(n: Normal, depth_m: float) -> tuple[Matrix, Matrix, NDArray[np.bool_]]:
    """Split the information into principal directions, rotations measured by the shift they make at the usual depth.

    Returns (eigenvalues [6], directions as columns [6, 6], which ones the images decide [6]) (Zhang et al. 2016).
    """
    unit = np.repeat([1.0, 1.0 / depth_m], 3)
    eigenvalues, directions = np.linalg.eigh(n.H * np.outer(unit, unit))
    return eigenvalues, directions * unit[:, None], eigenvalues > DEGENERATE * max(eigenvalues[-1], 1e-300)


def _solve(n: Normal, depth_m: float) -> tuple[Matrix, int]:
    """Return the Gauss–Newton update −H⁻¹ b within the directions the images decide, and how many they do not."""
    eigenvalues, directions, decided = _axes(n, depth_m)
    basis = directions[:, decided]
    return -basis @ ((basis.T @ n.b) / eigenvalues[decided]), int((~decided).sum())


def _symmetric(upper: Matrix) -> Matrix:
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = upper
    return full + np.triu(full, 1).T


def gradient_magnitude(gray: Image) -> Image:
    """Return the Sobel gradient magnitude of gray [H, W]."""
    return np.hypot(sobel(gray, 0), sobel(gray, 1))
