"""Make paths for a camera to fly: along a recorded one, calmed and at an even rate, or in a circle above a place."""

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from sigmasplat.errors import SigmaSplatError
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.types import Matrix

CALM_S = 0.25
"""Standard deviation of the average that takes a hand's tremble out of a path."""
FINE_HZ = 120.0
ORBIT_ELEVATION_RAD = np.deg2rad(50.0)


def resampled(trajectory: Trajectory, images: int, calm_s: float = CALM_S) -> Matrix:
    """Return T_world_camera [images, 4, 4] at even times from the first pose to the last, averaged over about `calm_s`.

    Between poses it goes straight and turns evenly. Raises SigmaSplatError without a pose, or unless images ≥ 1.
    """
    if not len(trajectory) or images < 1:
        raise SigmaSplatError(f"no path of {images} images can be made of {len(trajectory)} poses")
    times, first = np.unique(trajectory.timestamps_s, return_index=True)
    poses = trajectory.T_world_camera[first]
    if len(times) == 1:
        return np.repeat(poses, images, axis=0)
    fine = np.linspace(times[0], times[-1], max(2, round((times[-1] - times[0]) * FINE_HZ) + 1, images))
    width = calm_s / (fine[1] - fine[0])
    positions = np.stack([np.interp(fine, times, poses[:, k, 3]) for k in range(3)], 1)
    quaternions = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(fine).as_quat()
    turned_over = np.cumsum(np.r_[0, (quaternions[1:] * quaternions[:-1]).sum(1) < 0]) % 2
    quaternions *= np.where(turned_over, -1.0, 1.0)[:, None]  # q and −q are one rotation, but do not average
    values = np.concatenate([positions, quaternions], 1)
    calm = gaussian_filter1d(values, width, axis=0, mode="nearest") if width > 0 else values
    wanted = np.linspace(0, len(fine) - 1, images)
    values = np.stack([np.interp(wanted, np.arange(len(fine)), calm[:, k]) for k in range(7)], 1)
    out = np.tile(np.eye(4), (images, 1, 1))
    out[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
    out[:, :3, 3] = values[:, :3]
    return out


def orbit(
    center: Matrix, up: Matrix, start: Matrix, radius_m: float, images: int, elevation_rad: float = ORBIT_ELEVATION_RAD
) -> Matrix:
    """Return T_world_camera [images, 4, 4] once round a point, looking at it from above at `radius_m`.

    up: unit vector; start: a direction, from whose side the first image looks; the last image is one step before it.
    """
    ahead = start - (start @ up) * up
    ahead /= np.linalg.norm(ahead)
    aside = np.cross(ahead, up)
    angle = 2.0 * np.pi * np.arange(images)[:, None] / images
    outward = -(np.cos(angle) * ahead + np.sin(angle) * aside)
    outward = np.cos(elevation_rad) * outward + np.sin(elevation_rad) * up
    return np.stack([looking(center + radius_m * out, -out, up) for out in outward])


def looking(position: Matrix, forward: Matrix, up: Matrix) -> Matrix:
    """Return T_world_camera at a position, looking along a unit vector, `up` being up in its image."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = right, np.cross(forward, right), forward, position
    return T
