"""The smooth error of predicted depth over the image, measured by the motion of the camera.

The true inverse depth is (1 + θ · φ(u, v)) times the predicted one; φ are polynomials of the image position up to
degree 2. Features matched between two views with parallax show θ without a known scale and without a known motion: both
views fit together at one θ only. Each pair of views gives the information on θ that is left when its motion is
eliminated.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.tracking.feature_image import FeatureImage
from sigmasplat.tracking.features import Extractor, Features
from sigmasplat.types import Matrix

TERMS = 5
SPREAD = 0.2
"""Standard deviation of each θ before anything is measured."""
KEPT = 0.95
"""Share of the information that is kept at each keyframe: θ may change slowly."""
VIEWS = 5
"""A keyframe is compared with this many earlier ones."""
LEAST_MATCHES = 20
PIXEL_PX, DEPTH_SHARE = 0.5, 0.05
"""Standard deviations of a match: of the image position, and of the depth at one pixel, as a share of it."""
STEPS = 8
CAUCHY = 2.4
MEDIAN_OF_SQUARE = 1.39
"""Median of χ² for 2 degrees of freedom."""
LEAST_SCALE = 0.3
CORRELATED = 4.0
"""Pairs of views share features, so that each counts as this fraction of independent ones."""
MOST = 1.0
NEAREST = 0.1
"""Points nearer than this, as a share of the median depth, are not used."""
FACTOR_RANGE = (0.3, 3.0)


@dataclass(frozen=True, eq=False)
class DepthShape:
    """θ [5] with its information [5, 5], and the views that the next keyframe is compared with: the images of keyframes
    with predicted depth, and their poses T_newest_camera [4, 4] relative to the newest one."""

    theta: Matrix
    information: Matrix
    views: tuple[tuple[FeatureImage, Matrix], ...] = ()

    @staticmethod
    def unknown() -> "DepthShape":
        """Return the shape before anything is measured: no error."""
        return DepthShape(np.zeros(TERMS), np.eye(TERMS) / SPREAD**2)

    def corrected(self, predicted_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return predicted depth [H, W] without its smooth error; 0 stays 0."""
        height, width = predicted_m.shape
        v, u = np.meshgrid(np.linspace(-1.0, 1.0, height), np.linspace(-1.0, 1.0, width), indexing="ij")
        factor = 1.0 + np.tensordot(self.theta, _polynomials(u, v), 1)
        return np.asarray(predicted_m / np.clip(factor, *FACTOR_RANGE), np.float32)

    def without_views(self) -> "DepthShape":
        """Return the shape to go on with where the motion since the last keyframe is not known."""
        return replace(self, views=())

    def after(self, image: FeatureImage, T_last_new: Matrix, extractor: Extractor) -> "DepthShape":
        """Return the shape that a new keyframe with its predicted depth shows; T_last_new [4, 4]: its tracked pose
        relative to the last keyframe."""
        prior = np.eye(TERMS) / SPREAD**2
        found = replace(self, information=KEPT * self.information + (1.0 - KEPT) * prior)
        T_new_last = se3.inverse(T_last_new)
        views = [(seen, T_new_last @ T) for seen, T in self.views]
        new, z = image.features(extractor), depth_at(image, extractor)
        for seen, T in views:
            old, old_z = seen.features(extractor), depth_at(seen, extractor)
            pairs = extractor.match(old, new)
            if len(pairs) < LEAST_MATCHES:
                continue
            a, b = pairs.T
            found = found._measured(old.take(a), old_z[a], new.take(b), T)
            found = found._measured(new.take(b), z[b], old.take(a), se3.inverse(T))
        kept = tuple([*views, (image, np.eye(4))][-VIEWS:])
        return replace(found, views=kept)

    def _measured(self, first: Features, z: Matrix, second: Features, T_second_first: Matrix) -> "DepthShape":
        """Return the shape after matched features [M] of two views, the first with predicted depth z [M]."""
        kept = z > 0
        if kept.sum() < LEAST_MATCHES:
            return self
        pair = _Pair(first.take(kept), z[kept], second.take(kept))
        T, theta = T_second_first, self.theta
        for _ in range(STEPS):
            H, g = pair.normal(T, theta)
            full, slope = H.copy(), g.copy()
            full[6:, 6:] += self.information
            slope[6:] += self.information @ (theta - self.theta)
            step = np.linalg.solve(full + 1e-9 * np.diag(np.diag(full)) + 1e-12 * np.eye(len(full)), -slope)
            T, theta = se3.exp(step[:6]) @ T, theta + step[6:]
            if not np.isfinite(theta).all() or np.abs(theta).max() > MOST:
                return self  # the matches contradict each other
        H, _ = pair.normal(T, theta)
        own = H[:6, :6] + 1e-9 * np.diag(np.diag(H[:6, :6])) + 1e-12 * np.eye(6)
        left = H[6:, 6:] - H[6:, :6] @ np.linalg.solve(own, H[:6, 6:])
        return replace(self, theta=theta, information=self.information + (left + left.T) / (2.0 * CORRELATED))


class _Pair:
    """Matched features of two views: the normal equations of the reprojection error in motion and θ."""

    def __init__(self, first: Features, z: Matrix, second: Features) -> None:
        c, points = first.camera, first.points.astype(np.float64)
        u, v = points.T
        self.camera, self.seen, self.z = second.camera, second.points.astype(np.float64), z
        self.rays = np.stack([(u - c.cx) / c.fx, (v - c.cy) / c.fy, np.ones(len(u))], 1)
        self.shapes = _polynomials(2.0 * u / (c.width - 1) - 1.0, 2.0 * v / (c.height - 1) - 1.0).T
        self.nearest_m = NEAREST * float(np.median(z))

    def normal(self, T: Matrix, theta: Matrix) -> tuple[Matrix, Matrix]:
        """Return H [11, 11] and gradient [11] of the robust error in the left twist of T and in θ."""
        c, factor = self.camera, np.clip(1.0 + self.shapes @ theta, *FACTOR_RANGE)
        turned = (self.rays * (self.z / factor)[:, None]) @ T[:3, :3].T
        moved = turned + T[:3, 3]
        x, y, depth = moved[:, 0], moved[:, 1], np.maximum(moved[:, 2], self.nearest_m)
        error = np.stack([c.fx * x / depth + c.cx, c.fy * y / depth + c.cy], 1) - self.seen
        J = np.zeros((len(x), 2, 3))
        J[:, 0, 0], J[:, 0, 2] = c.fx / depth, -c.fx * x / depth**2
        J[:, 1, 1], J[:, 1, 2] = c.fy / depth, -c.fy * y / depth**2
        along = J @ (-turned / factor[:, None])[:, :, None]  # of the image position, by the factor of the inverse depth
        zero, z = np.zeros_like(x), moved[:, 2]
        turn = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)
        A = np.concatenate([J, J @ turn, along * self.shapes[:, None, :]], 2)
        noise = DEPTH_SHARE * factor[:, None] * along[:, :, 0]
        weight = np.linalg.inv(PIXEL_PX**2 * np.eye(2) + noise[:, :, None] * noise[:, None, :])
        chi2 = np.einsum("ni,nij,nj->n", error, weight, error)
        scale = max(float(np.median(chi2)) / MEDIAN_OF_SQUARE, LEAST_SCALE)
        robust = (moved[:, 2] > self.nearest_m) / (1.0 + chi2 / (CAUCHY**2 * scale)) ** 2 / scale
        weighed = robust[:, None, None] * (weight @ A)
        return np.einsum("nij,nik->jk", A, weighed), np.einsum("nij,ni->j", weighed, error)


def _polynomials(u: Matrix, v: Matrix) -> Matrix:
    """Return the shapes [5, …] at image positions from −1 to 1."""
    return np.stack([u, v, u * v, u * u - 1.0 / 3.0, v * v - 1.0 / 3.0])


def depth_at(image: FeatureImage, extractor: Extractor) -> Matrix:
    """Return the predicted depth at each feature [N], of the nearest pixel; 0 = none."""
    features, camera = image.features(extractor), image.camera
    c = features.camera
    u, v = features.points.T.astype(np.float64)
    column = np.rint((u - c.cx) / c.fx * camera.fx + camera.cx).astype(np.intp)
    row = np.rint((v - c.cy) / c.fy * camera.fy + camera.cy).astype(np.intp)
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    z = image.depth_m[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)].astype(np.float64)
    return np.where(inside, z, 0.0)
