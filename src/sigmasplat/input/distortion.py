"""Remove lens distortion: radial-tangential model, forward, inverse and as a remap table."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera

Points = NDArray[np.float64]


def distort(points: Points, coefficients: Points) -> Points:
    """Map ideal image points [..., 2] (x/z, y/z) to distorted image points.

    Coefficients k1, k2, p1, p2, k3 [, k4, k5, k6], the last three for the rational model (OpenCV's order).
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(coefficients, (0, 8 - len(coefficients)))
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        -1,
    )


def undistort(points: Points, coefficients: Points, iterations: int = 50) -> Points:
    """Invert `distort` by fixed-point iteration; it converges if the distortion is monotonic within the image."""
    ideal = points.copy()
    for _ in range(iterations):
        ideal = ideal + (points - distort(ideal, coefficients))
    return ideal


class Undistortion:
    """Resample distorted images to the pinhole camera with the same focal lengths and principal point.

    Depth is resampled together with colour: TUM's depth is registered to the *distorted* colour image, so undistorting
    colour alone would misalign them by up to 20 pixels in the corners (the CG-SLAM release undistorts colour only).
    Colour is interpolated. Depth takes the nearest reading, because a mean of a near and a far surface is no surface.
    """

    def __init__(self, camera: Camera, coefficients: Points) -> None:
        self.camera = camera
        self.coefficients = coefficients

    @cached_property
    def _source_uv(self) -> NDArray[np.float32]:
        """Position of each ideal pixel in the recorded image, [H·W, 2] pixels."""
        c = self.camera
        lens = distort(c.rays()[..., :2].astype(np.float64), self.coefficients)
        return (lens * [c.fx, c.fy] + [c.cx, c.cy]).reshape(-1, 2).astype(np.float32)

    @cached_property
    def _corners(self) -> tuple[list[NDArray[np.intp]], list[NDArray[np.float32]]]:
        """Flat indices and weights of the four recorded pixels around each ideal pixel; clamped to the image."""
        width, height = self.camera.width, self.camera.height
        u = self._source_uv[:, 0].clip(0, width - 1)
        v = self._source_uv[:, 1].clip(0, height - 1)
        u0, v0 = np.floor(u).astype(np.intp), np.floor(v).astype(np.intp)
        u1, v1 = np.minimum(u0 + 1, width - 1), np.minimum(v0 + 1, height - 1)
        a, b = (u - u0)[:, None], (v - v0)[:, None]
        indices = [v0 * width + u0, v0 * width + u1, v1 * width + u0, v1 * width + u1]
        return indices, [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]

    @cached_property
    def _nearest(self) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        width, height = self.camera.width, self.camera.height
        uv = np.rint(self._source_uv).astype(np.intp)
        inside = np.asarray((uv >= 0).all(1) & (uv < [width, height]).all(1))
        return np.where(inside, uv[:, 1] * width + uv[:, 0], 0), inside

    def color(self, recorded: NDArray[np.float32]) -> NDArray[np.float32]:
        """Resample colour [H, W, 3] bilinearly; outside the recorded image edge pixels repeat (depth is 0)."""
        flat = recorded.reshape(-1, 3)
        indices, weights = self._corners
        total = sum((flat[i] * w for i, w in zip(indices, weights, strict=True)), np.zeros_like(flat))
        return np.clip(total, 0.0, 1.0).astype(np.float32).reshape(recorded.shape)

    def depth(self, recorded_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Resample depth [H, W] by the nearest reading; 0 outside the recorded image."""
        index, inside = self._nearest
        return np.where(inside, recorded_m.reshape(-1)[index], 0.0).astype(np.float32).reshape(recorded_m.shape)
