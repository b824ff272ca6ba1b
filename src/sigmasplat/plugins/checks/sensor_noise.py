"""Measure how noisy depth readings are: residuals of planes fitted to small patches, against their distance."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.optimize import nnls

from sigmasplat.config.sensors import SensorModel, sensor_model
from sigmasplat.data.frame import Frame
from sigmasplat.fit.pyramid import NOISE_PER_M

Floats = NDArray[np.float64]

PATCHES_ACROSS = 36
"""The width of a patch is this share of the image's, at least `LEAST_PX`: a sensor's noise is correlated over a few
pixels, so small patches would show too little of it."""
LEAST_PX = 7
SAME_SURFACE = 1.1
"""Patches with a larger ratio of depths contain a step."""
CURVED = 0.7
"""If a quadratic surface leaves less than this share of a plane's squared residuals, the patch is not flat."""
LEAST_COSINE = 0.5
"""Patches seen at more than 60° are left out: they are noisier."""
LEAST_PATCHES, BINS = 60, 12
SHOWN_M = (1.0, 2.0, 4.0)


@dataclass(frozen=True)
class SensorNoise:
    """The measured model, from how many patches, and their distances (5 % and 95 %)."""

    model: SensorModel
    patches: int
    range_m: tuple[float, float]

    def row(self, sensor: str) -> str:
        """Describe the noise beside that of the model in use (`input.sensor`)."""
        measured, used = (_in_mm(model) for model in (self.model, in_use(sensor)))
        return (
            f"{measured} at {', '.join(f'{z:g}' for z in SHOWN_M)} m, from {self.patches} flat patches at "
            f"{self.range_m[0]:.1f} to {self.range_m[1]:.1f} m; in use ({sensor}): {used}; measured model: "
            f"--set input.sensor={self.model}"
        )

    def record(self, sensor: str) -> dict[str, Any]:
        """Return the measurement as values for JSON."""
        return {
            "base_m": self.model.base, "z2_per_m": self.model.z2, "patches": self.patches, "range_m": self.range_m,
            "at_m": SHOWN_M, "std_m": [std_at(self.model, z) for z in SHOWN_M], "model": str(self.model),
            "in_use": {"sensor": sensor, "std_m": [std_at(in_use(sensor), z) for z in SHOWN_M]},
        }  # fmt: skip


def in_use(sensor: str) -> SensorModel:
    """Return the model that `input.sensor` names; for the generic law, that of structured light."""
    return sensor_model(sensor) or SensorModel(z2=NOISE_PER_M)


def std_at(model: SensorModel, z_m: float) -> float:
    """Return σ at a distance, m, without the factors of edges and angles."""
    return float(np.sqrt(model.base**2 + (model.z1 * z_m) ** 2 + (model.z2 * z_m * z_m) ** 2))


def measure_noise(frames: Sequence[Frame]) -> SensorNoise | None:
    """Fit σ² = base² + (z2·z²)² to the residuals of flat patches; None without enough of them.

    Patches are sorted by distance into bins of equal size; the median of a bin is robust to patches that are not flat.
    """
    found = [(np.zeros(0), np.zeros(0)), *(flat_patches(frame) for frame in frames)]
    z, std = (np.concatenate([values[k] for values in found]) for k in (0, 1))
    if len(z) < LEAST_PATCHES:
        return None
    bins = [part for part in np.array_split(np.argsort(z), BINS) if len(part)]
    at, square = (np.array([np.median(values[part]) for part in bins]) for values in (z, std * std))
    square = np.maximum(square, 1e-12)
    columns = np.stack([np.ones_like(at), at**4], 1) / square[:, None]  # relative errors
    (base2, z22), _ = nnls(columns, np.ones_like(at))
    low, high = np.percentile(z, (5, 95)).tolist()
    return SensorNoise(SensorModel(base=float(np.sqrt(base2)), z2=float(np.sqrt(z22))), len(z), (low, high))


def flat_patches(frame: Frame) -> tuple[Floats, Floats]:
    """Return the distance and the standard deviation of the residuals of each flat patch of a frame, m [P].

    The inverse depth of a plane is affine in the image, so the fit is linear.
    """
    camera, size = frame.camera, max(LEAST_PX, frame.camera.width // PATCHES_ACROSS // 2 * 2 + 1)
    if min(frame.depth_m.shape) < size:
        return np.zeros(0), np.zeros(0)
    windows = sliding_window_view(frame.depth_m, (size, size))[::size, ::size]
    patches = windows.reshape(-1, size * size).astype(np.float64)
    v, u = (size * index.ravel() + size // 2 for index in np.indices(windows.shape[:2]))
    whole = (patches.min(1) > 0) & (patches.max(1) < SAME_SURFACE * patches.min(1))
    patches, u, v = patches[whole], u[whole], v[whole]
    z, w = patches.mean(1), 1.0 / np.maximum(patches, 1e-9)
    across, down = (x.ravel() - size // 2 for x in np.meshgrid(np.arange(size), np.arange(size)))
    plane = np.stack([np.ones(size * size), across, down], 1)
    curved = np.concatenate([plane, np.stack([across**2, across * down, down**2], 1)], 1)
    fitted = w @ np.linalg.pinv(plane).T
    rest, least = (((w - w @ (np.linalg.pinv(A).T @ A.T)) ** 2).sum(1) for A in (plane, curved))
    normal = np.stack([
        camera.fx * fitted[:, 1], camera.fy * fitted[:, 2],
        fitted[:, 0] - fitted[:, 1] * (u - camera.cx) - fitted[:, 2] * (v - camera.cy),
    ])  # fmt: skip
    ray = np.sqrt(1.0 + ((u - camera.cx) / camera.fx) ** 2 + ((v - camera.cy) / camera.fy) ** 2)
    cosine = fitted[:, 0] / (ray * np.linalg.norm(normal, axis=0))
    flat = (least > CURVED * rest) & (cosine > LEAST_COSINE)
    return z[flat], (z * z * np.sqrt(rest / (size * size - 3)))[flat]


def _in_mm(model: SensorModel) -> str:
    return ", ".join(f"{1000 * std_at(model, z):.2g}" for z in SHOWN_M) + " mm"
