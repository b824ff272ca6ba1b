"""Make camera paths: a recorded one, smoothed and resampled at an even rate, or an orbit around a point."""

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SigmaSplatError
from sigmasplat.types import Matrix

SMOOTHING_S = 0.25
"""Standard deviation of the Gaussian that removes camera shake."""
FINE_HZ = 120.0
ORBIT_ELEVATION_RAD = np.deg2rad(50.0)


def smooth_path(trajectory: Trajectory, images: int, smoothing_s: float = SMOOTHING_S) -> Matrix:
    """Return T_world_camera [images, 4, 4] at even times from the first to the last pose, without camera shake.

    Poses are interpolated linearly (rotations: slerp) and smoothed with a Gaussian of `smoothing_s`. Raises
    SigmaSplatError without a pose, or unless images ≥ 1.
    """
    if not len(trajectory) or images < 1:
        raise SigmaSplatError(f"cannot make a path of {images} images from {len(trajectory)} poses")
    times, first = np.unique(trajectory.timestamps_s, return_index=True)
    poses = trajectory.T_world_camera[first]
    if len(times) == 1:
        return np.repeat(poses, images, axis=0)
    fine = np.linspace(times[0], times[-1], max(2, round((times[-1] - times[0]) * FINE_HZ) + 1, images))
    width = smoothing_s / (fine[1] - fine[0])
    positions = np.stack([np.interp(fine, times, poses[:, k, 3]) for k in range(3)], 1)
    quaternions = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(fine).as_quat()
    flipped = np.cumsum(np.r_[0, (quaternions[1:] * quaternions[:-1]).sum(1) < 0]) % 2
    quaternions *= np.where(flipped, -1.0, 1.0)[:, None]  # q and −q are the same rotation, but must not be averaged
    values = np.concatenate([positions, quaternions], 1)
    smooth = gaussian_filter1d(values, width, axis=0, mode="nearest") if width > 0 else values
    times = np.linspace(0, len(fine) - 1, images)
    values = np.stack([np.interp(times, np.arange(len(fine)), smooth[:, k]) for k in range(7)], 1)
    out = np.tile(np.eye(4), (images, 1, 1))
    out[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
    out[:, :3, 3] = values[:, :3]
    return out


def orbit(
    center: Matrix, up: Matrix, start: Matrix, radius_m: float, images: int, elevation_rad: float = ORBIT_ELEVATION_RAD
) -> Matrix:
    """Return T_world_camera [images, 4, 4] of one circle around a point, looking down at it from `radius_m` away.

    up: unit vector; start: horizontal direction in which the first image looks. The last image is one step before the
    first one.
    """
    ahead = start - (start @ up) * up
    ahead /= np.linalg.norm(ahead)
    sideways = np.cross(ahead, up)
    angle = 2.0 * np.pi * np.arange(images)[:, None] / images
    outward = -(np.cos(angle) * ahead + np.sin(angle) * sideways)
    outward = np.cos(elevation_rad) * outward + np.sin(elevation_rad) * up
    return np.stack([look_along(center + radius_m * out, -out, up) for out in outward])


def look_along(position: Matrix, forward: Matrix, up: Matrix) -> Matrix:
    """Return T_world_camera at a position, looking along the unit vector `forward`; `up` points up in the image."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = right, np.cross(forward, right), forward, position
    return T
