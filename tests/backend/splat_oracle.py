"""Render scenes once more, in numpy, pair by pair front to back: an oracle that shares no formula with the kernels.

It inverts the 2D covariance instead of factoring it and walks the splats instead of taking cumulative products. On the
way it measures how far every decision (α threshold, 0.99, stop, ½, near plane) is from flipping.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from splat_scenes import Scene

Array = NDArray[np.float64]


@dataclass
class Picture:
    """What the oracle sees; `weights` [N, H, W] holds each pair's w, `margin` the smallest distance to a flip."""

    weights: Array
    sums: Array
    moment: Array
    alpha: Array
    median_id: NDArray[np.int64]
    margin: float


def jacobian(p: Array, scene: Scene) -> Array:
    """Differentiate the pinhole at p [3], with the ray held inside the image widened by 15 % on either side."""
    c = scene.camera
    tx = np.clip(p[0] / p[2], -(c.cx + 0.15 * c.width) / c.fx, (1.15 * c.width - c.cx) / c.fx)
    ty = np.clip(p[1] / p[2], -(c.cy + 0.15 * c.height) / c.fy, (1.15 * c.height - c.cy) / c.fy)
    return np.array([[c.fx, 0.0, -c.fx * tx], [0.0, c.fy, -c.fy * ty]]) / p[2]


def flat(scene: Scene, i: int) -> tuple[Array, Array, float]:
    """Project splat i: mean [2] px, covariance [2, 2] px², depth m."""
    c, T = scene.camera, scene.T_camera_world.numpy()
    p = T[:3, :3] @ scene.means[i].numpy() + T[:3, 3]
    R = T[:3, :3] @ se3.rotation_from_quaternion(scene.quats[i].numpy())
    M = R @ np.diag(scene.scales[i].numpy() ** 2) @ R.T
    J = jacobian(p, scene)
    mean = np.array([c.fx * p[0] / p[2] + c.cx, c.fy * p[1] / p[2] + c.cy])
    return mean, J @ M @ J.T + scene.options.low_pass_px2 * np.eye(2), float(p[2])


def depths(scene: Scene) -> Array:
    """Return every splat's depth, metres, [N]."""
    T = scene.T_camera_world.numpy()
    return scene.means.numpy() @ T[2, :3] + T[2, 3]


def look(scene: Scene) -> Picture:
    """Composite the scene."""
    c, options = scene.camera, scene.options
    v, u = np.mgrid[: c.height, : c.width].astype(float)
    light, weights = np.ones_like(u), np.zeros((len(scene.means), c.height, c.width))
    median_id = np.full(u.shape, -1)
    z = depths(scene)
    flips = [float(np.abs(z / options.near_m - 1).min(initial=1.0))]
    for i in np.argsort(z, kind="stable"):
        if z[i] <= options.near_m:
            continue
        mean, covariance, _ = flat(scene, i)
        d = np.stack([u - mean[0], v - mean[1]], -1)
        raw = float(scene.opacities[i]) * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", d, np.linalg.inv(covariance), d))
        alpha = np.where(raw >= options.alpha_min, np.minimum(raw, 0.99), 0.0)
        counts = (light >= options.transmittance_stop) & (alpha > 0)
        weights[i] = np.where(counts, light * alpha, 0.0)
        after = light * (1 - alpha)
        median_id[counts & (light >= 0.5) & (after < 0.5)] = i
        with np.errstate(divide="ignore"):
            for value, threshold in ((raw, options.alpha_min), (raw, 0.99), (after, options.transmittance_stop)):
                flips.append(float(np.abs(np.log(value / threshold)).min()))
        flips.append(float(np.abs(after - 0.5).min()))
        light = np.where(counts, after, light)
    ref = scene.ref_depth.numpy()
    off = np.where(ref > 0, z[:, None, None] - ref, 0.0)
    return Picture(
        weights,
        np.einsum("nhw,nk->hwk", weights, scene.features.numpy()),
        (weights * off**2).sum(0),
        weights.sum(0),
        median_id,
        min(flips),
    )
