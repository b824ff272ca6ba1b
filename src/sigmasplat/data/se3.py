"""Compute rigid motions: SE(3) in double precision with numpy. `T_a_b` converts coordinates in b to coordinates in a.

A twist is ξ = (ρ, φ): translation first, then rotation vector (radians).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sigmasplat.types import Matrix


def hat(w: Matrix) -> Matrix:
    """Return the cross-product matrix [w]× of a 3-vector (or of a stack [..., 3])."""
    out = np.zeros((*w.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -w[..., 0], -w[..., 1], -w[..., 2]
    return out


def _series(theta2: float) -> tuple[float, float, float]:
    """Return sinθ/θ, (1−cosθ)/θ², (θ−sinθ)/θ³; for small θ by Taylor series."""
    if theta2 < 1e-8:
        return 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0, 1.0 / 6.0 - theta2 / 120.0
    theta = float(np.sqrt(theta2))
    return (
        float(np.sin(theta) / theta),
        float((1.0 - np.cos(theta)) / theta2),
        float((theta - np.sin(theta)) / (theta2 * theta)),
    )


def exp(xi: NDArray[np.floating]) -> Matrix:
    """Convert a twist ξ=(ρ, φ), shape [6], to a 4×4 rigid transform."""
    rho, phi = np.asarray(xi[:3], float), np.asarray(xi[3:], float)
    k = hat(phi)
    a, b, c = _series(float(phi @ phi))
    kk = k @ k
    T = np.eye(4)
    T[:3, :3] = np.eye(3) + a * k + b * kk
    T[:3, 3] = (np.eye(3) + b * k + c * kk) @ rho
    return T


def log(T: Matrix) -> Matrix:
    """Convert a 4×4 rigid transform to its twist ξ=(ρ, φ), shape [6], |φ| ≤ π."""
    phi = log_rotation(T[:3, :3])
    k = hat(phi)
    _, b, c = _series(float(phi @ phi))
    left_jacobian = np.eye(3) + b * k + c * (k @ k)
    return np.concatenate([np.linalg.solve(left_jacobian, T[:3, 3]), phi])


def log_rotation(R: Matrix) -> Matrix:
    """Convert a 3×3 rotation to its rotation vector, radians; stable near 0 and near π."""
    w, x, y, z = quaternion_from_rotation(R)
    vector = np.array([x, y, z])
    norm = float(np.linalg.norm(vector))
    if norm < 1e-12:
        return 2.0 * vector
    return vector * (2.0 * float(np.arctan2(norm, w)) / norm)


def inverse(T: Matrix) -> Matrix:
    """Invert a rigid transform (or a stack [..., 4, 4]) without a general matrix inverse."""
    out = np.zeros_like(T)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = Rt
    out[..., :3, 3] = -(Rt @ T[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def adjoint(T: Matrix) -> Matrix:
    """Return Ad(T) [..., 6, 6], which transforms twists between frames: T exp(ξ) T⁻¹ = exp(Ad(T) ξ)."""
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = hat(T[..., :3, 3]) @ R
    return out


def displacement(T: Matrix) -> Matrix:
    """Return the matrix [..., 6, 6] from a left twist of T to the displacement of T's origin and the rotation, both in
    the axes of the outer frame: a twist (ρ, φ) moves the origin p by ρ + φ × p."""
    out = np.broadcast_to(np.eye(6), (*T.shape[:-2], 6, 6)).copy()
    out[..., :3, 3:] = -hat(T[..., :3, 3])
    return out


def exp_stack(xi: Matrix) -> Matrix:
    """Convert twists [N, 6] to transforms [N, 4, 4]: `exp` for many twists."""
    k = hat(xi[:, 3:])
    kk = k @ k
    theta = np.linalg.norm(xi[:, 3:], axis=1)[:, None, None]
    a, b = np.sinc(theta / np.pi), 0.5 * np.sinc(theta / (2 * np.pi)) ** 2
    # (1 − a)/θ² is inaccurate for very small θ, but there it is multiplied by k² = O(θ²).
    c = (1.0 - a) / np.maximum(theta, 1e-100) ** 2
    T = np.tile(np.eye(4), (len(xi), 1, 1))
    T[:, :3, :3] += a * k + b * kk
    T[:, :3, 3] = ((np.eye(3) + b * k + c * kk) @ xi[:, :3, None])[..., 0]
    return T


def log_stack(T: Matrix) -> Matrix:
    """Convert transforms [N, 4, 4] to twists [N, 6], |φ| ≤ π: `log` for many transforms."""
    phi = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    k, theta2 = hat(phi), (phi * phi).sum(1)[:, None, None]
    h, _ = _half_cotangent(theta2)
    inverse_v = np.eye(3) - 0.5 * k + (1.0 - h) / np.maximum(theta2, 1e-200) * (k @ k)
    return np.concatenate([(inverse_v @ T[:, :3, 3, None])[..., 0], phi], axis=1)


def left_jacobian_inverse(xi: Matrix) -> Matrix:
    """Return J⁻¹(ξ) [N, 6, 6] for twists [N, 6], |φ| < 2π: log(exp(δ) exp(ξ)) = ξ + J⁻¹(ξ) δ + O(δ²).

    J⁻¹ = ad / (exp(ad) − 1), ad = ad(ξ). Because ad (ad² + θ²)² = 0, the power series is finite: 1 − ad/2 + p ad² + q
    ad⁴. p and q follow from the value and slope of x/2·coth(x/2) at x = iθ.
    """
    k = hat(xi[:, 3:])
    ad = np.zeros((len(xi), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = k
    ad[:, :3, 3:] = hat(xi[:, :3])
    theta2 = (xi[:, 3:] ** 2).sum(1)[:, None, None]
    h, slope = _half_cotangent(theta2)
    safe = np.maximum(theta2, 1e-2)
    q = np.where(theta2 > 1e-2, (theta2 * slope - h + 1.0) / safe**2, -1 / 720 - theta2 / 15120 - theta2**2 / 403200)
    p = np.where(theta2 > 1e-2, 2.0 * q * theta2 - slope, 1 / 12 - theta2**2 / 30240)
    ad2 = ad @ ad
    return np.asarray(np.eye(6) - 0.5 * ad + p * ad2 + q * (ad2 @ ad2))


def _half_cotangent(theta2: Matrix) -> tuple[Matrix, Matrix]:
    """Return h = θ/2·cot(θ/2) and its derivative dh/dθ², 0 ≤ θ < 2π."""
    half = 0.5 * np.sqrt(np.maximum(theta2, 1e-16))
    h = half / np.tan(half)
    return h, (h - (half / np.sin(half)) ** 2) / (8.0 * half**2)


def rotation_from_quaternion(q_wxyz: Matrix) -> Matrix:
    """Convert quaternions [..., 4] (w first, any norm > 0) to rotations [..., 3, 3]."""
    q = np.asarray(q_wxyz, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quaternion_from_rotation(R: Matrix) -> Matrix:
    """Convert one 3×3 rotation to a unit quaternion wxyz with w ≥ 0 (largest-pivot form, stable everywhere)."""
    trace = float(np.trace(R))
    pivots = np.array([trace, R[0, 0], R[1, 1], R[2, 2]])
    i = int(np.argmax(pivots))
    q = np.empty(4)
    if i == 0:
        q[:] = [1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]
    else:
        a, b, c = (i - 1), i % 3, (i + 1) % 3
        q[0] = R[c, b] - R[b, c]
        q[1 + a] = 1.0 + R[a, a] - R[b, b] - R[c, c]
        q[1 + b] = R[b, a] + R[a, b]
        q[1 + c] = R[c, a] + R[a, c]
    q /= np.linalg.norm(q)
    return q if q[0] >= 0 else -q


def rotation_angle(R: Matrix) -> float:
    """Return the angle of a rotation in radians."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()  # for so few numbers, numpy needs ten times as long
    return math.atan2(math.hypot(h - f, c - g, d - b), a + e + i - 1.0)  # 2 sin and 2 cos


def interpolated(T: Matrix, T_next: Matrix, share: Matrix) -> Matrix:
    """Return the poses [N, 4, 4] that are a share [N] of the way from T to T_next, along a screw motion."""
    return np.asarray(exp_stack(share[:, None] * log_stack(T_next @ inverse(T))) @ T)


def rates(T: Matrix, times: NDArray[Any], at: NDArray[np.integer], known: NDArray[np.bool_]) -> Matrix:
    """Return how a camera moves at some rows of its path [F, 4, 4], between the rows before and after which are known:
    twists [N, 6] in its axes for each unit of the times [F]."""
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, len(T) - 1)
    before, after = np.where(known[before], before, at), np.where(known[after], after, at)
    return np.asarray(
        log_stack(inverse(T[before]) @ T[after]) / np.maximum(times[after] - times[before], 1e-3)[:, None]
    )


def orthonormalise(T: Matrix) -> Matrix:
    """Project the rotation of a pose [..., 4, 4] onto SO(3), so that errors do not accumulate over many products."""
    u, _, vt = np.linalg.svd(T[..., :3, :3])
    u[..., :, 2] *= np.linalg.det(u @ vt)[..., None]
    out = T.copy()
    out[..., :3, :3] = u @ vt
    return out


def is_rigid(T: Matrix, tolerance: float = 1e-3) -> bool:
    """Return whether a 4×4 matrix is rigid: finite, rotation orthonormal with determinant +1, last row 0 0 0 1."""
    return T.shape == (4, 4) and bool(are_rigid(T[None], tolerance)[0])


def are_rigid(T: Matrix, tolerance: float = 1e-3) -> NDArray[np.bool_]:
    """Return which matrices [N, 4, 4] are rigid, as `is_rigid`."""
    finite = np.asarray(np.isfinite(T).all((1, 2)))
    known = np.where(finite[:, None, None], T, np.eye(4))
    last_row = np.abs(known[:, 3] - [0, 0, 0, 1]).max(1) < tolerance
    return np.asarray(finite & last_row & _are_rotations(known[:, :3, :3], tolerance))


def is_rotation(R: Matrix, tolerance: float = 1e-3) -> bool:
    """Return whether a 3×3 matrix is a rotation: finite, orthonormal with determinant +1."""
    return R.shape == (3, 3) and bool(np.isfinite(R).all()) and bool(_are_rotations(R[None], tolerance)[0])


def _are_rotations(R: Matrix, tolerance: float) -> NDArray[np.bool_]:
    """Return which finite matrices [N, 3, 3] are orthonormal with determinant +1."""
    orthonormal = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max((1, 2)) < tolerance
    return np.asarray(orthonormal & (np.linalg.det(R) > 0))


def angle_between(T_one: Matrix, T_other: Matrix, depth_m: float) -> float:
    """Return by how much the image of one camera has moved in the other, rad: rotation plus translation divided by the
    mean depth; T_one, T_other [4, 4]: poses of the cameras."""
    moved_m = float(np.linalg.norm(T_other[:3, 3] - T_one[:3, 3]))
    return rotation_angle(T_one[:3, :3].T @ T_other[:3, :3]) + moved_m / depth_m
