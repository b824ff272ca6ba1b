"""Keyframes of one submap localised in another, and the pose that most localisations agree on."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sigmasplat.data import se3
from sigmasplat.fit.compare import Comparison
from sigmasplat.tracking.drift import floor, symmetric
from sigmasplat.types import Matrix


@dataclass(frozen=True, eq=False)
class Localisation:
    """A keyframe's pose in the other submap, expressed as T_a_b [4, 4] between the submaps; residual: the final loss;
    covariance [6, 6] of T_a_b's left twist (m, rad); agreement and overlap as in `PoseFit`; comparison: with the other
    map rendered at the pose, if it was made; at_keyframe: whether the other submap's recorded image gave the pose;
    keyframes: of a and of b, the localised one and the nearest one to it in the other submap."""

    T_a_b: Matrix
    residual: float
    covariance: Matrix
    agreement: float
    overlap: float
    comparison: Comparison | None = None
    at_keyframe: bool = False
    keyframes: tuple[int, int] = (0, 0)


def inverted(found: Localisation) -> Localisation:
    """Return the localisation with T_a_b [4, 4] inverted; the left twist of the inverse is −Ad(T⁻¹) ξ."""
    T = se3.inverse(found.T_a_b)
    A = se3.adjoint(T)
    return dataclasses.replace(found, T_a_b=T, covariance=A @ found.covariance @ A.T, keyframes=found.keyframes[::-1])


def differs(one: Matrix, other: Matrix, point_b: Matrix) -> tuple[float, float]:
    """Return the difference of two T_a_b [4, 4]: in metres at a point of b (point_b [3], m), and in radians."""
    apart = (one[:3, :3] - other[:3, :3]) @ point_b + one[:3, 3] - other[:3, 3]
    return float(np.linalg.norm(apart)), se3.rotation_angle(one[:3, :3].T @ other[:3, :3])


def consensus(found: Sequence[Localisation], point_b: Matrix, spread_m: float, spread_rad: float) -> list[Localisation]:
    """Return the largest group of localisations that agree with one of them; between equal groups, the one with the
    lower residual.

    Two agree if they map point_b [3] (m, in b) within `spread_m` of each other and their rotations differ by at most
    `spread_rad`.
    """
    best: list[Localisation] = []
    for centre in sorted(found, key=lambda f: f.residual):
        apart = [differs(centre.T_a_b, f.T_a_b, point_b) for f in found]
        near = [f for f, (m, rad) in zip(found, apart, strict=True) if m <= spread_m and rad <= spread_rad]
        if len(near) > len(best):
            best = near
    return best


def combined(found: Sequence[Localisation]) -> Matrix:
    """Average T_a_b [4, 4] with weights 1/residual (VarSplat §5); the rotation is the nearest to the weighted mean."""
    weights = np.array([1.0 / max(f.residual, 1e-9) for f in found])
    mean = np.eye(4)
    mean[:3] = np.einsum("k,kij->ij", weights / weights.sum(), np.stack([f.T_a_b[:3] for f in found]))
    return se3.orthonormalise(mean)


def mean_covariance(found: Sequence[Localisation], mean: Matrix, scene_scale: float = 1.0) -> Matrix:
    """Return the covariance [6, 6] of the mean T_a_b: estimated covariance + spread + floor.

    mean: T_a_b [4, 4]; of its left twist, m and rad. The covariance is not divided by the number of localisations: they
    use the same two maps, so their errors are correlated.
    """
    twists = np.stack([se3.log(f.T_a_b @ se3.inverse(mean)) for f in found])
    covariance = np.mean([f.covariance for f in found], 0) + twists.T @ twists / len(found)
    return symmetric(covariance) + floor(scene_scale)
