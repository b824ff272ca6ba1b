"""Standard deviations of depth readings: from a sensor's model, resized with the depth, as weights."""

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config.sensors import SensorModel, sensor_model
from sigmasplat.data.camera import Camera
from sigmasplat.env import opencv

Floats = NDArray[np.float32]

EDGE_SHARE = 0.05
"""Two neighbouring readings that differ by more than this share of the nearer one are on two surfaces."""
SMOOTHED_PX = 5
"""Normals are those of a surface that is averaged over a window of this width: their noise must be far below 1."""
LEAST_COSINE = 0.2
"""Smallest cos θ: normals of surfaces seen at less than 12° are not measured well enough."""
MOST_WEIGHT = 4.0
"""Largest weight of a reading in a loss."""


def modelled_std(depth_m: Floats, model: SensorModel, camera: Camera) -> Floats:
    """Return the standard deviation of depth readings [H, W], m, 0 without a reading."""
    std = distance_std(depth_m, model)
    if model.edge != 1.0:
        std = np.where(beside_steps(depth_m), np.float32(model.edge) * std, std)
    if model.grazing:
        std = std * cosines(depth_m, camera) ** np.float32(-model.grazing)
    if model.most < 1.0:
        std = np.minimum(std, np.float32(model.most) * depth_m)
    return np.where(depth_m > 0, std, np.float32(0.0)).astype(np.float32)


def distance_std(depth_m: Floats, model: SensorModel) -> Floats:
    """Return the part of σ that depends on the distance alone, m [H, W]: √(base² + (z1·z)² + (z2·z²)²)."""
    linear, square = np.float32(model.z1) * depth_m, np.float32(model.z2) * depth_m * depth_m
    return np.asarray(np.sqrt(np.float32(model.base) ** 2 + linear * linear + square * square), np.float32)


def alignment_std(depth_m: Floats, model: SensorModel) -> Floats:
    """Return the standard deviation of readings in alignment, m [H, W], which does not average out `shared`.

    Only the distance counts: readings at edges and on slanted surfaces are noisier, but they are those that decide the
    pose.
    """
    return np.asarray(np.hypot(distance_std(depth_m, model), np.float32(model.shared) * depth_m * depth_m), np.float32)


def std_by_model(depth_m: Floats, camera: Camera, sensor: str) -> Floats | None:
    """Return the standard deviation of readings [H, W], m, by the model that `input.sensor` names; None without one."""
    model = sensor_model(sensor)
    return None if model is None else modelled_std(depth_m, model, camera)


def generic_std(depth_m: Floats, noise_per_m: float) -> Floats:
    """Return noise · z² of depth readings [H, W], m: the law that is used without a model."""
    return np.asarray(np.float32(noise_per_m) * depth_m * depth_m, np.float32)


def beside_steps(depth_m: Floats) -> NDArray[np.bool_]:
    """Return the readings [H, W] with a reading of another surface among their eight neighbours."""
    cv2, window = opencv(), np.ones((3, 3), np.uint8)
    read = depth_m > 0
    farthest = cv2.dilate(depth_m, window)
    nearest = cv2.erode(np.where(read, depth_m, np.float32(np.inf)), window)
    return np.asarray(read & (farthest - nearest > np.float32(EDGE_SHARE) * nearest))


def cosines(depth_m: Floats, camera: Camera) -> Floats:
    """Return |cos θ| of the angle between ray and normal of depth readings [H, W], at least `LEAST_COSINE`; 1 where the
    neighbours do not show a surface.

    The inverse depth w of a plane is affine in the image: its slopes give the normal (f_x w_u, f_y w_v, w at the
    principal point).
    """
    cv2, reach = opencv(), SMOOTHED_PX // 2
    read = (depth_m > 0).astype(np.float32)
    inverse = np.divide(read, depth_m, out=np.zeros_like(depth_m), where=read > 0)
    size, border = (SMOOTHED_PX, SMOOTHED_PX), cv2.BORDER_CONSTANT
    count = cv2.boxFilter(read, -1, size, normalize=False, borderType=border)
    w = cv2.boxFilter(inverse, -1, size, normalize=False, borderType=border) / np.maximum(count, np.float32(1.0))
    full, slopes = count == SMOOTHED_PX**2, []
    known = read > 0
    for axis in (1, 0):
        ahead, behind = np.roll(w, -reach, axis), np.roll(w, reach, axis)
        known = known & np.roll(full, -reach, axis) & np.roll(full, reach, axis)
        known &= np.abs(ahead - behind) < np.float32(EDGE_SHARE * 2 * reach) * w
        slopes.append((ahead - behind) / np.float32(2 * reach))
    v, u = np.indices(depth_m.shape, np.float32)
    off_u, off_v = u - np.float32(camera.cx), v - np.float32(camera.cy)
    normal = np.stack([camera.fx * slopes[0], camera.fy * slopes[1], w - slopes[0] * off_u - slopes[1] * off_v])
    ray = np.sqrt(1.0 + (off_u / camera.fx) ** 2 + (off_v / camera.fy) ** 2)
    cosine = w / np.maximum(ray * np.sqrt((normal**2).sum(0)), np.float32(1e-12))
    cosine = np.clip(cosine, LEAST_COSINE, 1.0)
    return np.where(known, cosine, np.float32(1.0)).astype(np.float32)


def relative_weights(std_m: Floats, usual_std_m: Floats) -> Floats:
    """Return weights of readings [H, W] in a loss of absolute errors: how many times as sure each is as usual, at most
    `MOST_WEIGHT`; 0 without a reading.

    The loss was balanced against colour for usual readings. If depth were followed without a limit, views would become
    unsharp.
    """
    weight = np.divide(usual_std_m, std_m, out=np.zeros_like(std_m), where=std_m > 0)
    return np.minimum(weight, np.float32(MOST_WEIGHT))
