"""Render a run as a video along its path or on an orbit: colour alone, or with depth and uncertainty beside it."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from sigmasplat.api import (
    Camera,
    FieldRenderer,
    GaussianField,
    Matrix,
    Progress,
    RunError,
    SigmaSplatError,
    Trajectory,
    evenly_spread,
    no_progress,
    replacing,
    se3,
)
from sigmasplat.plugins.evaluation.view_scores import COVERED_ALPHA, Renderer
from sigmasplat.plugins.outputs.drawing import colormap
from sigmasplat.plugins.outputs.drawing.colormap import Rgb
from sigmasplat.plugins.outputs.drawing.view_panels import ViewPanel, coloured, draw_view_strip
from sigmasplat.plugins.outputs.floorplan.ground import Edge, Floats, Up, floor_frame, sample_surfaces, up_of
from sigmasplat.plugins.outputs.run_reader import RunReader

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


SHORTEST_S, LONGEST_S, ORBIT_S = 4.0, 20.0, 12.0
SAMPLES = 12
"""Number of images from which the film's colour scale is computed."""
SURFACE_VIEWS = 20
CEILING_M = 0.1
"""On an orbit, splats higher than this above the camera's median height are removed: mostly the ceiling."""


def image_count(path_s: float, fps: float = 25.0, seconds: float | None = None, orbit: bool = False) -> int:
    """Return the number of images of a film of some seconds (None: `path_s`, within 4 to 20 s; 12 s for an orbit)."""
    usual = ORBIT_S if orbit else float(np.clip(path_s, SHORTEST_S, LONGEST_S))
    return max(1, round((seconds or usual) * fps))


def export_video(
    reader: RunReader, target: Path, *, width_px: int = 0, fps: float = 25.0, seconds: float | None = None,
    orbit: bool = False, panels: bool = True, up: Edge = "auto", renderer: Renderer | None = None,
    progress: Progress = no_progress,
) -> int:  # fmt: skip
    """Write a video and return its number of images. Calls `progress(done, total)` at the start and after each image.

    width_px: width of a panel (0: that of the run's images); orbit: not along the run's path; panels: depth and
    uncertainty beside colour; up: at this edge of the images, for an orbit. Raises RunError on an unknown ending, or
    without a map or path.
    """
    config, path = reader.config, reader.valid_path()
    renderer = renderer or FieldRenderer(config.render, config.backend)
    field, camera = reader.run.read_map(), film_camera(reader.camera, width_px)
    count = image_count(float(path.timestamps_s[-1] - path.timestamps_s[0]), fps, seconds, orbit)
    if orbit:
        field, poses = orbit_view(
            field, path, camera, count, renderer, up_of(path.T_world_camera, reader.run.facts(), up)
        )
    else:
        poses = smooth_path(path, count)
    film = Film(field, camera, renderer)
    progress(0, count)
    write_video(target, film.images(poses, panels, progress), fps)
    return count


@dataclass(frozen=True, eq=False)
class Film:
    """A map, and how it is filmed: its camera and its renderer."""

    field: GaussianField
    camera: Camera
    renderer: Renderer

    def images(self, poses: Matrix, panels: bool, progress: Progress = no_progress) -> Iterator[Rgb]:
        """Yield an image for each pose [N, 4, 4]: colour, in `panels` with depth and √V beside it."""
        ranges = self._ranges(poses) if panels else None
        for done, pose in enumerate(poses, 1):
            color, depth_m, deviation, mapped = self._maps(pose)
            shown = ViewPanel("colour", np.asarray(np.rint(color * 255.0), np.uint8))
            if ranges is None:
                yield shown.pixels
            else:
                of_depth = coloured("depth", depth_m, mapped, ranges[0], colormap.VIRIDIS, " m")
                of_color = coloured("uncertainty", deviation, mapped, ranges[1], colormap.INFERNO)
                yield np.asarray(draw_view_strip([shown, of_depth, of_color], self.camera.width))
            progress(done, len(poses))

    def _ranges(self, poses: Matrix) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the colour ranges of a whole film from a few images: the 1st to the 99th percentile of depth, and 0 to
        the 99th of √V."""
        samples = zip(*(self._maps(pose) for pose in evenly_spread(list(poses), SAMPLES)), strict=True)
        _, depth_m, deviation, mapped = (np.stack(maps) for maps in samples)
        return colormap.value_range(depth_m, mapped), (0.0, colormap.value_range(deviation, mapped)[1])

    def _maps(self, T_world_camera: Matrix) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
        """Return colour [H, W, 3] in [0, 1], depth Σwz / Σw in m, √V of the mean over the channels, and where there is
        a surface."""
        with torch.inference_mode():
            seen = self.renderer(self.field, self.camera, se3.inverse(T_world_camera))
        alpha = seen.alpha.cpu()
        maps = (
            seen.color.cpu().clamp(0.0, 1.0),
            seen.depth.cpu() / alpha.clamp(min=COVERED_ALPHA),
            seen.variance.cpu().mean(-1).clamp(min=0.0).sqrt(),
        )
        color, depth_m, deviation = (np.asarray(values, np.float32) for values in maps)
        return color, depth_m, deviation, np.asarray(alpha > COVERED_ALPHA)


def film_camera(camera: Camera, width_px: int) -> Camera:
    """Return the camera resized to a width (0: unchanged), with even width and height as codecs require."""
    width = (width_px or camera.width) // 2 * 2
    return camera.resized(width, max(2, round(camera.height * width / camera.width / 2) * 2))


def orbit_view(
    field: GaussianField, path: Trajectory, camera: Camera, images: int, renderer: Renderer, up: Up | None = None,
) -> tuple[GaussianField, Matrix]:  # fmt: skip
    """Return the map without its ceiling, and poses [images, 4, 4] on a circle above it from which it is visible;
    up: as in `floor_frame`."""
    samples = list(sample_surfaces(field, path, camera, renderer, SURFACE_VIEWS))
    T = floor_frame(samples, up)
    points = np.concatenate([sample.points for sample in samples]) @ T[:3, :3].T + T[:3, 3]
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    ceiling_m = float(np.median(path.T_world_camera[:, :3, 3] @ T[2, :3] + T[2, 3])) + CEILING_M
    middle = np.append((low + high)[:2] / 2.0, min(ceiling_m, 0.8) / 2.0)
    half_view = np.arctan(min(camera.width / camera.fx, camera.height / camera.fy) / 2.0)
    radius_m = 0.85 * float(np.linalg.norm((high - low)[:2]) / 2.0 / np.sin(half_view))
    T_world_floor = se3.inverse(T)
    center = T_world_floor[:3, :3] @ middle + T_world_floor[:3, 3]
    kept = field.moved(torch.eye(4))  # makes a copy
    kept.keep(torch.from_numpy(field.means.numpy().astype(np.float64) @ T[2, :3] + T[2, 3] < ceiling_m))
    return kept, orbit(center, T[2, :3], T[1, :3], radius_m, images)


CODEC, ENDING = "vp09", ".mp4"


def write_video(path: Path, images: Iterable[Rgb], fps: float) -> None:
    """Write images uint8 RGB [H, W, 3] of equal size as an MP4 file with VP9, atomically.

    VP9 needs even sizes: an odd last row or column is dropped. Raises RunError on another ending, an unwritable file or
    a missing codec.
    """
    if path.suffix.lower() != ENDING:
        raise RunError(f"cannot write a video as {path.name}; give a name that ends in {ENDING}")
    with replacing(path) as temporary:
        scratch = temporary.with_suffix(ENDING)  # OpenCV selects the format by the ending
        try:
            _encode(scratch, images, fps)
            os.replace(scratch, temporary)
        finally:
            scratch.unlink(missing_ok=True)


def _encode(path: Path, images: Iterable[Rgb], fps: float) -> None:
    import cv2

    writer, size = None, (0, 0)
    try:
        for image in images:
            if writer is None:
                size = (image.shape[1] // 2 * 2, image.shape[0] // 2 * 2)
                fourcc = cv2.VideoWriter.fourcc(*CODEC)
                writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, fps, size)
                if not writer.isOpened():
                    raise RunError(f"cannot write {path.name} with this OpenCV, which lacks VP9; reinstall it")
            writer.write(np.ascontiguousarray(image[: size[1], : size[0], ::-1]))
    finally:
        if writer is not None:
            writer.release()
    if writer is None:
        raise RunError("a video needs at least one image, found none")
