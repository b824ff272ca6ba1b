"""Align two RGB-D images directly: Gauss–Newton on SE(3), coarse to fine, gray and depth residuals together.

The reference may be a rendered map (tracking) or the previous frame (odometry). One render and a dozen steps of 0.1 ms
replace dozens of renders.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import sobel

from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.render.backend import backend_module

Image = NDArray[np.float32]
Matrix = NDArray[np.float64]

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
HUBER_GRAY = (0.02, 0.05, 0.1)
"""Width of the gray residual's quadratic part, from the finest level up: far from the answer all of them are large."""
HUBER_DEPTH_RELATIVE = (0.003, 0.006, 0.012)
"""The same for depth, times z² (m): from a structured-light sensor's noise (Khoshelham & Elberink 2012) up."""
DEPTH_GATES_M = (0.1, 0.2, 0.4)
"""Depth residuals beyond are other surfaces; from the finest level up."""
MIN_PIXELS = 60


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Gray in [0, 1] and depth in metres (0 = none) at halving sizes, finest first, with their cameras."""

    gray: list[Image]
    depth: list[Image]
    weight: list[Image | None]
    cameras: list[Camera]

    @staticmethod
    def of(gray: Image, depth_m: Image, camera: Camera, weight: Image | None = None, levels: int = 3) -> "Pyramid":
        """Halve gray [H, W], depth [H, W] and an optional weight [H, W] until `levels` sizes exist."""
        p = Pyramid([np.ascontiguousarray(gray)], [np.ascontiguousarray(depth_m)], [weight], [camera])
        for _ in range(levels - 1):
            c = p.cameras[-1]
            if min(c.width, c.height) < 32:
                break
            last = p.weight[-1]
            p.gray.append(_quarter(p.gray[-1]).mean(0))
            p.depth.append(_half_depth(p.depth[-1]))
            p.weight.append(None if last is None else _quarter(last).mean(0))
            # Odd sizes drop their last row or column, so the scale is exactly ½.
            p.cameras.append(
                Camera(c.width // 2, c.height // 2, c.fx / 2, c.fy / 2, (c.cx - 0.5) / 2, (c.cy - 0.5) / 2)
            )
        return p


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
    that land on a live reading; covariance [6, 6] of the left twist (ρ, φ), m and rad; cost per pixel; steps taken."""

    T_live_reference: Matrix
    agreement: float
    overlap: float
    covariance: Matrix
    cost: float
    steps: int


def align(
    reference: Pyramid,
    live: Pyramid,
    T_live_reference: Matrix,
    iterations: int = 8,
    weight_color: float = 0.5,
    update_stop: float = 1e-4,
) -> Alignment:
    """Find the motion that lays the reference onto the live image, from a first guess.

    Each level takes up to `iterations` Gauss–Newton steps with Huber weights and stops below `update_stop` (m, rad).
    weight_color in [0, 1] balances gray against depth, each in units of its Huber width.
    Raises BackendError without the compiled kernels.
    """
    backend_module("cpu")  # refuses in one line where the kernels are not built
    from sigmasplat.native import _core

    T, steps = np.array(T_live_reference, np.float64), 0
    H, b, sums = np.zeros(21), np.zeros(6), np.zeros(4)
    full = np.eye(6)
    for level in reversed(range(len(reference.cameras))):
        c = reference.cameras[level]
        huber_depth = HUBER_DEPTH_RELATIVE[min(level, 2)]
        for _ in range(iterations):
            _core.align_step(
                reference.gray[level], reference.depth[level], reference.weight[level], live.gray[level],
                live.depth[level], [c.fx, c.fy, c.cx, c.cy], weight_color, 1.0 - weight_color,
                HUBER_GRAY[min(level, 2)], huber_depth, DEPTH_GATES_M[min(level, 2)], T, H, b, sums,
            )  # fmt: skip
            steps += 1
            if sums[1] < MIN_PIXELS:
                break
            full = _symmetric(H)
            update = -np.linalg.solve(full + np.diag(1e-6 * np.diag(full) + 1e-9), b)
            T = se3.exp(update) @ T
            if np.abs(update).max() < update_stop:
                break
    reference_pixels = max(int((reference.depth[0] > 0).sum()), 1)
    return Alignment(
        se3.orthonormalise(T),
        agreement=float(sums[3] / max(sums[2], 1.0)),
        overlap=float(sums[2] / reference_pixels),
        covariance=_covariance(full, sums),
        cost=float(sums[0] / max(sums[1], 1.0)),
        steps=steps,
    )


def _covariance(information: Matrix, sums: Matrix) -> Matrix:
    """Invert the normal matrix and scale it by the mean squared residual; infinite where nothing was in common."""
    if sums[1] < MIN_PIXELS:
        return np.diag(np.full(6, np.inf))
    return np.asarray(np.linalg.pinv(information) * (sums[0] / sums[1]))


def _symmetric(upper: Matrix) -> Matrix:
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = upper
    return full + np.triu(full, 1).T


def gradient_magnitude(gray: Image) -> Image:
    """Return the Sobel gradient magnitude of gray [H, W]."""
    return np.hypot(sobel(gray, 0), sobel(gray, 1))
