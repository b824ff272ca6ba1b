"""Predicted depth: what is unknown in it is fitted, so that frames agree with each other and with the map.

A network's depth p has an arbitrary scale. The depth that is used is 1 / (s · f(u, v) / p + b): f is a smooth function
of the image position, the same for neighbouring frames (`DepthShape`); s and b are those of the frame.

The shape is f = 1 + θ · φ(u, v), with polynomials φ up to degree 2. Features matched between two views with parallax
show θ without a known scale and without a known motion: both views fit together at one θ only. Each pair of views gives
the information on θ that is left when its motion is eliminated.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.env import opencv
from sigmasplat.tracking.feature_image import FeatureImage
from sigmasplat.tracking.features import Extractor, Features, nearest_pixels
from sigmasplat.types import Matrix

TERMS = 5
SPREAD = 0.2
"""Standard deviation of each θ before anything is measured."""
KEPT = 0.95
"""Share of the information that is kept at each keyframe: θ may change slowly."""
VIEWS = 5
"""A keyframe is compared with this many earlier ones."""
FEWEST, STEPS = 20, 8
"""Fewest matches of two views, or cells of a frame, that are fitted to; steps of Gauss–Newton."""
PIXEL_PX, DEPTH_SHARE = 0.5, 0.05
"""Standard deviations of a match: of the image position, and of the depth at one pixel, as a share of it."""
CAUCHY = 2.4
"""Width of the Cauchy loss, standard deviations: it loses 5 % of the information of Gaussian errors."""
MEDIAN_OF_SQUARE, LEAST_SCALE = 1.39, 0.3
"""Median of χ² for 2 degrees of freedom; least factor on the stated variances, whatever few matches show."""
CORRELATED = 4.0
"""Pairs of views share features, so that each counts as this fraction of independent ones."""
MOST, FACTOR_RANGE = 1.0, (0.3, 3.0)
"""A larger θ shows that matches contradict each other; f stays in this range, also where nothing was matched."""
NEAREST = 0.1
"""Points nearer than this, as a share of the median depth, are not used."""


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
            if len(pairs) < FEWEST:
                continue
            a, b = pairs.T
            found = found._measured(old.take(a), old_z[a], new.take(b), T)
            found = found._measured(new.take(b), z[b], old.take(a), se3.inverse(T))
        return replace(found, views=(*views, (image, np.eye(4)))[-VIEWS:])

    def _measured(self, first: Features, z: Matrix, second: Features, T_second_first: Matrix) -> "DepthShape":
        """Return the shape after matched features [M] of two views, the first with predicted depth z [M]."""
        kept = z > 0
        if kept.sum() < FEWEST:
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
    column, row, inside = nearest_pixels(image.features(extractor), image.camera)
    return np.where(inside, image.depth_m[row, column].astype(np.float64), 0.0)


Floats = NDArray[np.float32]

CELL_PX = 8
"""s and b are fitted to the medians of cells of this width: the noise of pixels would bias a fit to inverse depth."""
ROUNDS, WIDTH, LEAST_SIGMA = 5, 1.5, 0.005
"""Rounds of reweighting; width of the Cauchy loss of cells, standard deviations; the least of these, share of depth."""
STIFF_SCALE, STIFF_SHIFT = 1.0, 10.0
"""Weight of s = 1 and of b = 0 against the cells. Without the first, errors of the map would add up over keyframes."""
LEAST_INVERSE = 1e-3
"""Predicted surfaces farther than the inverse of this, m, have no depth."""
DIAMETER_PX, SPREAD_PX, SPREAD_SIGMA = 9, 3.0, 3.0
HOLE = -20.0
"""Logarithm of the depth of a pixel without depth: so far from all others that its weight is 0."""


@dataclass(frozen=True, eq=False)
class DepthFit:
    """What is known of the depth that a network predicts: its shape over the image, and s and b of the last frame."""

    shape: DepthShape = field(default_factory=DepthShape.unknown)
    scale: float = 1.0
    shift: float = 0.0

    def applied(self, predicted_m: Floats) -> Floats:
        """Return the depth [H, W] to use in the place of predicted depth; 0 stays 0."""
        shaped = self.shape.corrected(predicted_m)
        read = shaped > 0
        inverse = self.scale / np.where(read, shaped, np.float32(1.0)) + self.shift
        known = read & (inverse > LEAST_INVERSE)
        return np.where(known, 1.0 / np.where(known, inverse, 1.0), 0.0).astype(np.float32)

    def fitted(self, predicted_m: Floats, known_m: Floats) -> "DepthFit":
        """Return the fit with s and b of a frame, so that its depth agrees with the known depth [H, W], 0 = unknown;
        the same fit if too little is known."""
        shaped = self.shape.corrected(predicted_m)
        both = (shaped > 0) & (known_m > 0)
        found, known = _medians(shaped, both), _medians(known_m, both)
        used = (found > 0) & (known > 0)
        if used.sum() < FEWEST:
            return self
        z = known[used]
        middle = float(np.median(z))
        A = np.stack([z / found[used], z / middle], 1)
        stiff, goal = np.diag([STIFF_SCALE, STIFF_SHIFT]), np.array([1.0, 0.0])
        x = np.array([1.0 / float(np.median(1.0 / A[:, 0])), 0.0])
        for _ in range(ROUNDS):
            error = np.abs(A @ x - 1.0)
            sigma = max(1.4826 * float(np.median(error)), LEAST_SIGMA)
            weight = 1.0 / (1.0 + (error / (WIDTH * sigma)) ** 2)
            weight /= weight.sum()
            x = np.linalg.solve(A.T @ (weight[:, None] * A) + stiff, A.T @ weight + stiff @ goal)
        return replace(self, scale=float(x[0]), shift=float(x[1]) / middle)


NOTHING_FITTED = DepthFit()


def smoothed(predicted_m: Floats) -> Floats:
    """Return predicted depth [H, W] smoothed by a bilateral filter as far as its pixels are noisy; 0 stays 0."""
    read = predicted_m > 0
    logarithm = np.where(read, np.log(np.where(read, predicted_m, 1.0)), HOLE).astype(np.float32)
    noise = pixel_noise(predicted_m)
    if not noise > 0:
        return predicted_m
    smooth = opencv().bilateralFilter(logarithm, DIAMETER_PX, SPREAD_SIGMA * noise, SPREAD_PX)
    return np.where(read, np.exp(smooth), 0.0).astype(np.float32)


def pixel_noise(depth_m: Floats) -> float:
    """Return the standard deviation of the noise of pixels, as a share of the depth, from the inverse depth of three
    neighbours, which is affine on planes; 0 without depth."""
    left, middle, right = depth_m[:, :-2], depth_m[:, 1:-1], depth_m[:, 2:]
    known = (left > 0) & (middle > 0) & (right > 0)
    if not known.any():
        return 0.0
    bend = middle[known] / left[known] + middle[known] / right[known] - 2.0
    return float(1.4826 * np.median(np.abs(bend)) / np.sqrt(6.0))


def _medians(depth_m: Floats, both: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the median of each cell of `CELL_PX`², 0 where less than half of its pixels are in `both`."""
    n, rows, columns = CELL_PX, depth_m.shape[0] // CELL_PX, depth_m.shape[1] // CELL_PX
    values = np.where(both, depth_m, np.inf)[: rows * n, : columns * n]
    values = np.sort(values.reshape(rows, n, columns, n).swapaxes(1, 2).reshape(rows, columns, n * n), axis=-1)
    count = np.isfinite(values).sum(-1)
    median = np.take_along_axis(values, np.maximum(count - 1, 0)[..., None] // 2, -1)[..., 0]
    return np.where(2 * count >= n * n, median, 0.0).astype(np.float64)
