"""Seeding: choose the pixels that become splats, and make the splats (VarSplat §2)."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, sobel
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from skimage.feature import canny
from torch import Tensor

from sigmasplat.config import SeedConfig
from sigmasplat.data.field import GaussianField
from sigmasplat.fit.target import Target, gray_of
from sigmasplat.fit.tracking_loss import PoseMaps

Mask = NDArray[np.bool_]
SAME_SURFACE = 0.05
"""Neighbouring readings show one surface if they differ by less than this share of the depth."""
STRETCH_MOST = 3.0


def first_pixels(target: Target, config: SeedConfig, random: np.random.Generator) -> Mask:
    """Choose pixels for an empty map, bool [H, W]: uniform, by gradient, and on Canny edges; only with depth."""
    valid, gray = target.depth_image.numpy() > 0, gray_of(target.image.numpy())
    chosen = _draw(valid * 1.0, config.first_uniform, random)
    chosen |= _draw(np.hypot(sobel(gray, 0), sobel(gray, 1)).astype(np.float64) * valid, config.first_gradient, random)
    if config.first_edges:
        edges = canny(gray, low_threshold=100 / 255, high_threshold=200 / 255)  # type: ignore[no-untyped-call]
        chosen |= binary_dilation(edges, np.ones((2, 2), bool))
    return np.asarray(chosen & valid)


def later_pixels(maps: PoseMaps, target: Target, config: SeedConfig) -> Mask:
    """Find pixels that the map does not explain, bool [H, W]: low opacity (A < alpha_below), or a rendered surface far
    behind the depth reading (if `depth_error_factor` is above 0)."""
    measured = target.depth_image.numpy()
    valid = measured > 0
    alpha = maps.alpha.cpu().numpy()
    surface = maps.depth.cpu().numpy() / np.maximum(alpha, 0.5)
    seen = valid & (alpha >= config.alpha_below)
    chosen = valid & (alpha < config.alpha_below)
    if config.depth_error_factor > 0 and seen.any():
        error = np.abs(surface - measured)
        limit = max(config.depth_error_factor * float(np.median(error[seen])), config.depth_error_least_m)
        chosen |= seen & (surface - measured > limit)
    return chosen


def thin_out(pixels: Mask, config: SeedConfig, random: np.random.Generator) -> Mask:
    """Keep a random share of the pixels, bool [H, W]: `density` of them, at most `later_max`."""
    count = round(config.density * int(pixels.sum()))
    return _draw(pixels * 1.0, min(count, config.later_max or count), random)


def _draw(weight: NDArray[np.floating], count: int, random: np.random.Generator) -> Mask:
    """Draw up to `count` distinct pixels with probability ∝ weight [H, W] (exponential keys: one sort, no retries)."""
    candidates = np.flatnonzero(weight > 0)
    chosen = np.zeros(weight.shape, bool)
    if count <= 0:
        return chosen
    if len(candidates) > count:
        keys = random.exponential(size=len(candidates)) / weight.ravel()[candidates]
        candidates = candidates[np.argpartition(keys, count)[:count]]
    chosen.ravel()[candidates] = True
    return chosen


def make_splats(
    target: Target, T_world_camera: NDArray[np.float64], pixels: Mask, spacing_px: float, field: GaussianField,
    config: SeedConfig,
) -> GaussianField:  # fmt: skip
    """Unproject pixels to splats: opacity from the settings, colour from the image, σ² = e⁻⁷, isotropic scale, or discs
    with `thickness` below 1.

    pixels: bool [H, W], all with depth. T_world_camera [4, 4] is the pose in the frame of `field`, the existing splats.
    The scale follows the distance to the 3 nearest neighbours, old and new; with `scale_from` "pixel" it is the size of
    a pixel at that depth times `spacing_px`, the distance between seeds. New points closer than `min_distance_m` to an
    existing splat are dropped.
    """
    depth = target.depth_image.numpy()[pixels].astype(np.float64)
    points = target.camera.rays()[pixels] * depth[:, None] * config.push_back
    colors = target.image.numpy()[pixels]
    world = points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    if config.scale_from == "pixel":
        spread = depth / target.camera.fx * spacing_px
        keep = np.ones(len(world), bool)
    else:
        keep, spread = _neighbour_spread(world, field.means, config)
    scales, quats = np.repeat(np.maximum(spread * config.scale_factor, 1e-4)[:, None], 3, 1), None
    if config.thickness != 1.0:
        axes, stretch = discs(target, pixels)
        on_surface = stretch > 0
        scales[on_surface, 0] *= stretch[on_surface]
        scales[on_surface, 2] *= config.thickness
        turned = Rotation.from_matrix(T_world_camera[:3, :3] @ axes[keep]).as_quat(scalar_first=True)
        quats = torch.as_tensor(turned, dtype=torch.float32)
    return GaussianField.from_values(
        torch.as_tensor(world[keep], dtype=torch.float32),
        torch.as_tensor(scales[keep], dtype=torch.float32),
        torch.as_tensor(colors[keep], dtype=torch.float32),
        quats=quats,
        opacities=config.opacity,
    )


def discs(target: Target, pixels: Mask) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the axes of discs on the surface at pixels [H, W] with depth: camera frame, [P, 3, 3], and stretch [P].

    Columns: along the surface away from the camera, across it, and the normal. The first axis is longer than the second
    by the stretch 1 / cos of the viewing angle, at most `STRETCH_MOST`; the stretch is 0, and the axes are those of the
    camera, where a neighbour has no reading or shows another surface.
    """
    rays, (v, u) = target.camera.rays(), np.nonzero(pixels)
    depth = target.depth_image.numpy().astype(np.float64)
    around = np.pad(depth, 1)  # outside the image there is no reading
    beside = [(v + row, u + column) for row, column in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    neighbours = np.stack([around[row + 1, column + 1] for row, column in beside])
    known: Mask = np.all((np.abs(neighbours - depth[pixels]) < SAME_SURFACE * depth[pixels]) & (neighbours > 0), axis=0)
    inside = [(row.clip(0, depth.shape[0] - 1), column.clip(0, depth.shape[1] - 1)) for row, column in beside]
    right, left, below, above = (rays[at] * z[:, None] for at, z in zip(inside, neighbours, strict=True))
    normal = np.cross(right - left, below - above)
    view = rays[pixels] / np.linalg.norm(rays[pixels], axis=1, keepdims=True)
    length = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(length, 1e-12)[:, None]
    cosine = (normal * view).sum(1)
    away = view - cosine[:, None] * normal
    off = np.linalg.norm(away, axis=1)
    frontal = np.cross(np.eye(3)[1], normal)  # any direction on a surface seen at a right angle
    away = np.where(off[:, None] > 1e-3, away / np.maximum(off, 1e-12)[:, None], frontal)
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    axes = np.stack([away, np.cross(normal, away), normal], 2)
    disc = known & (length > 0)
    stretch = np.where(disc, np.minimum(1.0 / np.maximum(np.abs(cosine), 1e-6), STRETCH_MOST), 0.0)
    return np.where(disc[:, None, None], axes, np.eye(3)), stretch


def _neighbour_spread(
    points: NDArray[np.float64], means: Tensor, config: SeedConfig
) -> tuple[Mask, NDArray[np.float64]]:
    """Return which new points to keep, and the root mean square distance of each to its 3 nearest neighbours among the
    old points (means [N, 3]) and the new ones."""
    keep = np.ones(len(points), bool)
    if len(points) == 0:
        return keep, np.zeros(0)
    low, high = (torch.from_numpy(corner).to(means.device) for corner in (points.min(0) - 0.1, points.max(0) + 0.1))
    near = means[((means > low) & (means < high)).all(1)].cpu().numpy()
    if len(near) and config.min_distance_m > 0:
        nearest = cKDTree(near).query(points, distance_upper_bound=config.min_distance_m)[0]
        keep = np.asarray(nearest) > config.min_distance_m
    judged = config.outlier_neighbours > 0 and (config.outlier_first or len(means) > 0)
    if judged and len(points) > config.outlier_neighbours:
        mean = np.asarray(cKDTree(points).query(points, config.outlier_neighbours + 1)[0])[:, 1:].mean(1)
        keep &= mean < mean.mean() + 2.0 * mean.std()
    everything = np.concatenate([points, near]) if len(near) else points
    if len(everything) < 4:
        return keep, np.full(len(points), 0.01)
    distances = np.asarray(cKDTree(everything).query(points, 4)[0])[:, 1:]
    return keep, np.sqrt((distances**2).mean(1))
