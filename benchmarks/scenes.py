"""Make splats from real depth, the maps of the CPU benchmark, and count the work of one image."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sigmasplat.config import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.errors import SourceError
from sigmasplat.fit.align import align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import gray_of
from sigmasplat.input.source import Source
from sigmasplat.plugins.sources import open_source
from sigmasplat.render import reference

DEPTH_RANGE_M = (0.1, 8.0)
OFFSETS = (0, 5, -5, 10, -10, 15, -15, 20, -20)
"""Frames whose pixels are added if the first has too few."""
LATER = 1
"""Tracking aligns the frame this many frames later to the map."""
LEAST_FIT = 0.3
"""A frame whose odometry explains less than this share is not used."""
Points = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scene:
    """A field back-projected from `frames` frames, in the camera coordinates of `frame`; `later` is to be tracked."""

    field: GaussianField
    frame: Frame
    later: Frame
    frames: int

    @property
    def camera(self) -> Camera:
        """Return the camera at the working size."""
        return self.frame.camera


def make_scene(path: str, index: int, splats: int, width: int, seed: int = 0) -> Scene:
    """Back-project frame `index` of a sequence to `splats` splats, seen `width` pixels wide.

    One isotropic splat per drawn pixel, as wide as the mean distance to 3 neighbours, opacity uniform in (.5, .99).
    Raises SourceError if the neighbouring frames have too few pixels.
    """
    source, random = open_source(path), np.random.default_rng(seed)
    points, colors, frames = gather(source, index, splats, random)
    distances = np.asarray(cKDTree(points).query(points, 4)[0])
    spread = distances[:, 1:].mean(1).clip(1e-4)
    field = GaussianField.from_values(
        torch.as_tensor(points, dtype=torch.float32),
        torch.as_tensor(spread, dtype=torch.float32),
        torch.as_tensor(colors, dtype=torch.float32),
        opacities=torch.as_tensor(random.uniform(0.5, 0.99, splats), dtype=torch.float32),
    )
    seen = [source.frame(i).prepared(width, *DEPTH_RANGE_M) for i in (index, index + LATER)]
    return Scene(field, seen[0], seen[1], frames)


def gather(
    source: Source, index: int, count: int, random: np.random.Generator
) -> tuple[Points, NDArray[np.float32], int]:
    """Draw points [count, 3] m and colours [count, 3] seen by frame `index`; return them and the frames used.

    All pixels of a frame are used before the next frame. Neighbouring frames are aligned by odometry, and only points
    inside the first image are used. Raises SourceError if all frames together have too few.
    """
    first = source.frame(index).prepared(0, *DEPTH_RANGE_M)
    parts, missing = [], count
    for i in (index + offset for offset in OFFSETS if 0 <= index + offset < len(source)):
        points, colors = _points(source.frame(i).prepared(0, *DEPTH_RANGE_M), first)
        drawn = random.permutation(len(points))[:missing]
        parts.append((points[drawn], colors[drawn]))
        missing -= len(drawn)
        if missing == 0:
            return np.concatenate([p for p, _ in parts]), np.concatenate([c for _, c in parts]), len(parts)
    raise SourceError(f"{source.name}: {count} splats asked for, the frames around {index} have {count - missing}")


def _points(frame: Frame, first: Frame) -> tuple[Points, NDArray[np.float32]]:
    """Back-project the readings of a frame into the first camera; keep those inside its image."""
    T_first_frame = np.eye(4) if frame.index == first.index else _odometry(first, frame)
    if T_first_frame is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.float32)
    valid = frame.depth_m > 0
    points = frame.camera.rays()[valid].astype(np.float64) * frame.depth_m[valid][:, None]
    points = points @ T_first_frame[:3, :3].T + T_first_frame[:3, 3]
    c, z = first.camera, np.maximum(points[:, 2], 1e-6)
    u, v = c.fx * points[:, 0] / z + c.cx, c.fy * points[:, 1] / z + c.cy
    inside = (points[:, 2] > DEPTH_RANGE_M[0]) & (u > 0) & (v > 0) & (u < c.width - 1) & (v < c.height - 1)
    return points[inside], frame.color[valid][inside]


def _odometry(first: Frame, other: Frame) -> Points | None:
    """Align two frames; return T_first_other, or None if they do not match. Ground truth is not read."""
    small = [frame.resized(320, round(320 * frame.camera.height / frame.camera.width)) for frame in (first, other)]
    pyramids = [Pyramid.of(gray_of(frame.color), frame.depth_m, frame.camera) for frame in small]
    found = align(pyramids[0], pyramids[1], np.eye(4), iterations=20)
    return se3.inverse(found.T_live_reference) if found.agreement * found.overlap > LEAST_FIT else None


def count_pairs(
    field: GaussianField, camera: Camera, options: RenderConfig, pixels: int, random: np.random.Generator
) -> tuple[float, float]:
    """Estimate how many (pixel, splat) pairs contribute to the image from the origin, and the standard error.

    Applies the rule of `blend` in numpy at `pixels` random pixels and scales up; exact if that is all pixels.
    """
    with torch.no_grad():
        p = reference.project(field.means, field.quats, field.scales, torch.eye(4), camera, options)
    order = np.argsort(p.z.numpy(), kind="stable")
    order = order[p.radii.numpy()[order, 0] > 0]
    opacities = field.opacities.detach().numpy()[order]
    splats = np.concatenate([p.means2d.numpy()[order], p.conics.numpy()[order], opacities[:, None]], 1)
    all_pixels = camera.width * camera.height
    drawn = random.permutation(all_pixels)[:pixels]
    counts = np.array([_pairs_at(i % camera.width, i // camera.width, splats, options) for i in drawn], np.float64)
    error = counts.std(ddof=1) / np.sqrt(len(counts)) if 1 < len(counts) < all_pixels else 0.0
    return float(counts.mean() * all_pixels), float(error * all_pixels)


def _pairs_at(u: int, v: int, splats: NDArray[np.float32], options: RenderConfig) -> int:
    """Count the splats (rows u, v, l1, l2, l3, opacity, near to far) that contribute to pixel (u, v)."""
    dy = v - splats[:, 1]
    near = np.abs(splats[:, 4] * dy) < np.sqrt(2 * np.log(1 / options.alpha_min))
    dx, dy, (l1, l2, l3, opacity) = u - splats[near, 0], dy[near], splats[near, 2:].T
    alpha = opacity * np.exp(-0.5 * ((l1 * dx + l2 * dy) ** 2 + (l3 * dy) ** 2))
    alpha = np.minimum(alpha[alpha >= options.alpha_min], reference.ALPHA_MAX).astype(np.float64)
    light = np.concatenate([[1.0], np.cumprod(1.0 - alpha)[:-1]]) if len(alpha) else np.zeros(0)
    return int((light >= options.transmittance_stop).sum())
