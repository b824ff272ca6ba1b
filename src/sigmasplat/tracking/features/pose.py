"""Compute a pose from matches between landmarks and features: RANSAC with P3P, then weighted Gauss–Newton."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.env import opencv
from sigmasplat.tracking.features.base import Features, Landmarks, depth_sigma_m
from sigmasplat.types import Matrix

LEAST_INLIERS = 8
RANSAC_PX = 3.0
"""A match supports a pose if its reprojection error is below this, in pixels of an image 640 pixels wide; it scales
with the width."""
RANSAC_TRIES = 1000
"""Maximum number of minimal samples per pose. Fewer are drawn if a pose is found with `CONFIDENCE` sooner."""
CONFIDENCE = 0.999
STEPS = 10
CAUCHY = 2.4
"""Width of the robust loss, in standard deviations of a residual."""
MEDIAN_OF_SQUARE = 0.7
"""Median of χ²/n for n = 2 or 3 degrees of freedom."""
LEAST_SCALE = 0.1
NO_READING_M2 = 1e6
"""Variance of the depth residual where the live frame has no reading."""
NEAREST_M = 0.05


@dataclass(frozen=True, eq=False)
class PnP:
    """A pose from matches: T_live_reference [4, 4]; which matches support it [M]; covariance [6, 6] of the left
    twist."""

    T_live_reference: Matrix
    supporting: NDArray[np.bool_]
    covariance: Matrix

    @property
    def inliers(self) -> int:
        """Return the number of supporting matches."""
        return int(self.supporting.sum())


def pose_from_landmarks(
    landmarks: Landmarks,
    features: Features,
    pairs: NDArray[np.intp],
    seed: int,
    live_depth_m: NDArray[np.floating] | None = None,
) -> PnP | None:
    """Find the motion from the landmarks' camera to the features' camera; None with fewer than 8 inliers.

    pairs [M, 2]: rows of landmarks and features; live_depth_m [N]: depth of each feature, 0 = no reading
    (`depth_readings`): it makes distances to surfaces more exact. The same input and seed give the same bits.
    """
    gate_px = RANSAC_PX * features.camera.width / 640.0
    if len(pairs) < LEAST_INLIERS:
        return None
    problem = _Problem(landmarks, features, pairs, live_depth_m)
    T = _ransac(problem, seed, gate_px, RANSAC_TRIES)
    if T is None:
        return None
    # A second round includes matches that only the improved pose supports.
    for _ in range(2):
        supporting = problem.errors_px(T) < gate_px
        if supporting.sum() < LEAST_INLIERS:
            return None
        T, covariance = problem.fitted(T, supporting)
    supporting = problem.errors_px(T) < gate_px
    return PnP(T, supporting, covariance) if supporting.sum() >= LEAST_INLIERS else None


class _Problem:
    """The matched points, their images and noise, as arrays [M, …]."""

    def __init__(
        self,
        landmarks: Landmarks,
        features: Features,
        pairs: NDArray[np.intp],
        live_depth_m: NDArray[np.floating] | None,
    ) -> None:
        first, second = pairs.T
        self.camera = features.camera
        self.points = landmarks.points_m[first]
        self.weight = landmarks.weight[first]
        self.seen = features.points[second].astype(np.float64)
        z = self.points[:, 2]
        sideways = landmarks.features.sigma_px[first] * z / landmarks.features.camera.fx
        along = self.points / z[:, None]
        # Covariance of a landmark: depth noise along its ray, noise of its image across it.
        self.spread = landmarks.sigma_m[first, None, None] ** 2 * along[:, :, None] * along[:, None, :]
        self.spread += (sideways**2)[:, None, None] * np.diag([1.0, 1.0, 0.0])
        self.noise_px2 = features.sigma_px[second].astype(np.float64) ** 2
        self.depth = np.zeros(len(pairs)) if live_depth_m is None else np.asarray(live_depth_m, np.float64)[second]

    def errors_px(self, T: Matrix) -> Matrix:
        """Return the reprojection error of each match; infinite behind the camera."""
        moved = self.points @ T[:3, :3].T + T[:3, 3]
        front = moved[:, 2] > NEAREST_M
        error = np.linalg.norm(self._projected(np.where(front[:, None], moved, 1.0)) - self.seen, axis=1)
        return np.where(front, error, np.inf)

    def fitted(self, T: Matrix, chosen: NDArray[np.bool_]) -> tuple[Matrix, Matrix]:
        """Return the pose after Gauss–Newton with Cauchy weights on the chosen matches, and its covariance."""
        for _ in range(STEPS):
            H, b, _ = self._normal(T, chosen)
            step = np.linalg.solve(H + 1e-9 * np.diag(np.diag(H)), -b)
            T = se3.exp(step) @ T
            if np.abs(step).max() < 1e-7:
                break
        H, _, scale2 = self._normal(T, chosen)
        covariance = np.linalg.inv(H + 1e-12 * np.trace(H) * np.eye(6)) * scale2
        return se3.orthonormalise(T), covariance

    def _normal(self, T: Matrix, chosen: NDArray[np.bool_]) -> tuple[Matrix, Matrix, float]:
        """Return information H, gradient b with respect to the left twist, and the squared scale of the
        residuals in units of the noise model."""
        moved = self.points[chosen] @ T[:3, :3].T + T[:3, 3]
        z = np.maximum(moved[:, 2], NEAREST_M)
        depth = self.depth[chosen]
        c, zero = self.camera, np.zeros_like(z)
        J = np.stack(
            [
                c.fx / z,
                zero,
                -c.fx * moved[:, 0] / z**2,
                zero,
                c.fy / z,
                -c.fy * moved[:, 1] / z**2,
                zero,
                zero,
                zero + 1,
            ],
            1,
        ).reshape(-1, 3, 3)
        residual = np.concatenate(
            [self._projected(moved) - self.seen[chosen], np.where(depth > 0, z - depth, 0.0)[:, None]], 1
        )
        R = T[:3, :3]
        variance = J @ (R @ self.spread[chosen] @ R.T) @ J.transpose(0, 2, 1)
        own = np.where(depth > 0, depth_sigma_m(depth) ** 2, NO_READING_M2)
        variance += np.stack([self.noise_px2[chosen], self.noise_px2[chosen], own], 1)[:, :, None] * np.eye(3)
        information = np.linalg.inv(variance)
        squared = np.einsum("ni,nij,nj->n", residual, information, residual)
        freedom = 2.0 + (depth > 0)
        # The noise model gives ratios between matches; its scale differs by camera, so it is measured here.
        scale2 = max(float(np.median(squared / freedom)) / MEDIAN_OF_SQUARE, LEAST_SCALE**2)
        weight = self.weight[chosen] / (1.0 + squared / (scale2 * CAUCHY**2))
        G = np.concatenate([J, -J @ se3.hat(moved)], 2)
        pull = np.swapaxes(G, 1, 2) @ information * weight[:, None, None]
        return (pull @ G).sum(0), (pull @ residual[:, :, None]).sum(0)[:, 0], scale2

    def _projected(self, moved: Matrix) -> Matrix:
        c = self.camera
        z = np.maximum(moved[:, 2], NEAREST_M)
        return np.stack([c.fx * moved[:, 0] / z + c.cx, c.fy * moved[:, 1] / z + c.cy], 1)


def _ransac(problem: _Problem, seed: int, gate_px: float, tries: int) -> Matrix | None:
    """Return the pose that most matches support, from minimal samples (P3P) with local optimisation, or None."""
    cv2, c = opencv(), problem.camera
    order = np.random.default_rng(seed).permutation(len(problem.points))
    K = np.array([[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]])
    params = cv2.UsacParams()
    params.randomGeneratorState = seed % 2**31
    params.isParallel = False
    params.maxIterations, params.threshold, params.confidence = tries, gate_px, CONFIDENCE
    try:
        found, _, rotation, shift, _ = cv2.solvePnPRansac(
            problem.points[order], problem.seen[order], K, None, params=params
        )
    except cv2.error:  # all samples are degenerate, such as points on one line
        return None
    if not found or rotation is None or not (np.isfinite(rotation).all() and np.isfinite(shift).all()):
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], shift.ravel()
    return T
