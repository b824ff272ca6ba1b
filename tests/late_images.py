"""RGB-D images of a textured corner of a room, each row seen from where the camera is when the row is read."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from row_times import color_s, depth_s
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.readout import Readout
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import gray_of

Array = NDArray[np.float64]
CAMERA = Camera(160, 120, 128.0, 128.0, 79.5, 59.5)
PLANES = np.array([[0.25, 0.1, 1.0, 2.0], [-1.0, 0.2, 0.5, 1.6], [0.0, 1.0, 0.2, 1.1]])
"""Two walls and a floor, seen from within: n·x = d, (n, d), metres."""
WAVES_PER_M, PHASES = np.random.default_rng(5).normal(0.0, 7.0, (10, 3)), np.random.default_rng(6).uniform(0, 6.28, 10)


def texture(points: Array) -> Array:
    """Return a smooth gray value in [0, 1] at points [..., 3] of the world, metres."""
    return np.asarray(0.5 + 0.1 * np.sin(points @ WAVES_PER_M.T + PHASES).sum(-1)).clip(0.0, 1.0)


def cast(T_world_camera: Array) -> tuple[Array, Array]:
    """Return points of the world [H, W, 3] and their depths [H, W], m; T_world_camera [H, 4, 4]: one pose per row."""
    rays = np.einsum("hij,hwj->hwi", T_world_camera[:, :3, :3], CAMERA.rays())
    origins = T_world_camera[:, None, :3, 3]
    normals, distances = PLANES[:, :3], PLANES[:, 3]
    slopes = rays @ normals.T
    z = np.where(slopes > 1e-6, (distances - origins @ normals.T) / np.maximum(slopes, 1e-6), np.inf).min(-1)
    return origins + z[..., None] * rays, z


def frame(T_world_camera: Array, readout: Readout | None = None, seed: int | None = None) -> Frame:
    """Return the image of a camera at a pose [4, 4] that moves meanwhile; seed: of the sensor's noise, None: none."""
    rows = np.arange(CAMERA.height)
    late_s = np.zeros((2, CAMERA.height)) if readout is None else np.stack(
        [color_s(readout, rows, CAMERA.height), depth_s(readout, rows, CAMERA.height)]
    )  # fmt: skip
    rate = np.zeros(6) if readout is None else readout.rate
    of_color, of_depth = (T_world_camera @ se3.exp_stack(np.outer(times_s, rate)) for times_s in late_s)
    gray, z = texture(cast(of_color)[0]), cast(of_depth)[1]
    if seed is not None:
        random = np.random.default_rng(seed)
        gray, z = gray + random.normal(0.0, 0.01, gray.shape), z + random.normal(0.0, 0.002, z.shape) * z * z
    color = np.repeat(gray.clip(0.0, 1.0)[..., None], 3, 2).astype(np.float32)
    return Frame(0, 0.0, color, z.astype(np.float32), CAMERA)


def image(T_world_camera: Array, readout: Readout | None = None, seed: int | None = None) -> Pyramid:
    """Return the same for alignment, without knowledge of when its rows were read."""
    seen = frame(T_world_camera, readout, seed)
    return Pyramid.of(gray_of(seen.color), seen.depth_m, CAMERA)


SHAKEN, HERTZ = np.array([0.06, 0.05, 0.06, 0.07, 0.09, 0.1]), np.array([0.45, 0.7, 0.35, 0.6, 0.5, 0.8])


def path(times_s: Array) -> Array:
    """Return T_world_camera [N, 4, 4] of a hand that shakes; at 0 it is not at the origin."""
    return se3.exp_stack(SHAKEN * np.sin(2.0 * np.pi * np.outer(times_s, HERTZ) + np.arange(6)))


def film(frames: int, times_s: tuple[float, float, float]) -> Iterator[Frame]:
    """Yield what the camera in this hand sees at 30 Hz. times_s: of depth after colour, and of the rows of depth and
    colour, s. Each row is seen from where the camera has come to when it is read."""
    rows = (np.arange(CAMERA.height) + 0.5) / CAMERA.height - 0.5
    for i in range(frames):
        gray = texture(cast(path(i / 30 + times_s[2] * rows))[0])
        depth_m = cast(path(i / 30 + times_s[0] + times_s[1] * rows))[1]
        yield Frame(i, i / 30, np.repeat(gray[..., None], 3, 2).astype("f4"), depth_m.astype("f4"), CAMERA)
