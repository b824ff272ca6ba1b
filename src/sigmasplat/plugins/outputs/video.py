"""Render a run as a video along its path or on an orbit: colour alone, or with depth and uncertainty beside it."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

import sigmasplat.api as api
from sigmasplat.api import Camera, Matrix, Progress, RunError, Trajectory, se3
from sigmasplat.plugins.evaluation.view_scores import COVERED_ALPHA, Renderer
from sigmasplat.plugins.outputs.chosen_splats import kept_below
from sigmasplat.plugins.outputs.drawing import colormap
from sigmasplat.plugins.outputs.drawing.colormap import Rgb
from sigmasplat.plugins.outputs.drawing.view_panels import ViewPanel, coloured, draw_view_strip
from sigmasplat.plugins.outputs.first_look import sure
from sigmasplat.plugins.outputs.floorplan.ground import Edge, Floats, Up, floor_frame, sample_surfaces, up_of
from sigmasplat.plugins.outputs.run_reader import RunReader

SMOOTHING_S = 0.25
"""Standard deviation of the Gaussian that removes camera shake."""
FINE_HZ = 120.0
ORBIT_ELEVATIONS_RAD = np.deg2rad([25.0, 40.0, 55.0])
DIRECTIONS, WIDTH_PX, POINTS = 24, 96, 4000
"""An orbit is chosen by images so wide from so many directions; its radius by so many points of surfaces."""
ENOUGH = 0.75
"""The share of the surfaces that an orbit shows, and of the best direction's covered pixels that each other one has."""


def smooth_path(trajectory: Trajectory, images: int, smoothing_s: float = SMOOTHING_S) -> Matrix:
    """Return T_world_camera [images, 4, 4] at even times from the first to the last pose, without camera shake.

    Poses are interpolated linearly (rotations: slerp) and smoothed with a Gaussian of `smoothing_s`. Raises
    SigmaSplatError without a pose, or unless images ≥ 1.
    """
    if not len(trajectory) or images < 1:
        raise api.SigmaSplatError(f"cannot make a path of {images} images from {len(trajectory)} poses")
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
    center: Matrix, up: Matrix, start: Matrix, radius_m: float, angles_rad: Matrix, elevation_rad: float
) -> Matrix:
    """Return T_world_camera [N, 4, 4] on a circle around a point, looking down at it from `radius_m` away.

    up: unit vector; start: horizontal direction in which an image looks at the first of the angles [N], if that is 0.
    """
    ahead = start - (start @ up) * up
    ahead /= np.linalg.norm(ahead)
    sideways = np.cross(ahead, up)
    angle = angles_rad[:, None]
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
    orbit: bool = False, panels: bool = True, up: Edge = "auto", std_below_m: float | None = None,
    uncertain: bool = False, renderer: Renderer | None = None, progress: Progress = api.no_progress,
) -> int:  # fmt: skip
    """Write a video and return its number of images. Calls `progress(done, total)` at the start and after each image.

    width_px: width of a panel (0: that of the run's images); orbit: not along the run's path; panels: depth and
    uncertainty beside colour; up: at this edge of the images, for an orbit; std_below_m: as of `kept_below`, else the
    splats that are not `sure` are hidden, unless `uncertain`. Raises RunError on an unknown ending, or without a map or
    path.
    """
    config, path = reader.config, reader.valid_path()
    renderer = renderer or api.FieldRenderer(config.render, config.backend)
    film = Film.of(reader, film_camera(reader.camera, width_px), renderer, std_below_m, uncertain)
    count = image_count(float(path.timestamps_s[-1] - path.timestamps_s[0]), fps, seconds, orbit)
    if orbit:
        film, poses = orbit_view(film, path, count, up_of(path.T_world_camera, reader.run.facts(), up))
    else:
        film, poses = replace(film, seen_from=None), smooth_path(path, count)
    progress(0, count)
    write_video(target, film.images(poses, panels, progress), fps)
    return count


@dataclass(frozen=True, eq=False)
class Film:
    """A map, and how it is filmed: its camera and its renderer.

    seen_from: the mean directions [N, 3] that each splat was seen from; from behind it is hidden. None, [N, 0]: never.
    """

    field: api.GaussianField
    camera: Camera
    renderer: Renderer
    seen_from: Tensor | None = None

    @classmethod
    def of(
        cls, reader: RunReader, camera: Camera, renderer: Renderer, std_below_m: float | None = None,
        uncertain: bool = False,
    ) -> "Film":  # fmt: skip
        """Return a film of a run, as described in `export_video`."""
        field = reader.run.read_map()
        known = reader.run.uncertainty_of(field)
        if std_below_m is not None:
            kept = kept_below(reader.run.path, None if known is None else known.std, std_below_m)
        else:
            kept = sure(field, None if uncertain else known, reader.valid_path().T_world_camera[:, :3, 3])
        seen_from = None if known is None or uncertain else known.splats[kept][:, 3:]
        return cls(field.part(kept), camera, renderer, seen_from)

    def seen(self, T_world_camera: Matrix) -> api.Render:
        """Render the map from a pose [4, 4]."""
        field = self.field
        if self.seen_from is not None and self.seen_from.shape[1]:
            toward = torch.from_numpy(T_world_camera[:3, 3]).to(field.means) - field.means
            field = field.part((self.seen_from.to(toward) * toward).sum(1) >= 0.0)
        with torch.inference_mode():
            return self.renderer(field, self.camera, se3.inverse(T_world_camera))

    def images(self, poses: Matrix, panels: bool, progress: Progress = api.no_progress) -> Iterator[Rgb]:
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
        samples = zip(*(self._maps(pose) for pose in api.evenly_spread(list(poses), SAMPLES)), strict=True)
        _, depth_m, deviation, mapped = (np.stack(maps) for maps in samples)
        return colormap.value_range(depth_m, mapped), colormap.from_zero(deviation, mapped)

    def _maps(self, T_world_camera: Matrix) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
        """Return colour [H, W, 3] in [0, 1], depth Σwz / Σw in m, √V of the mean over the channels, and where there is
        a surface."""
        seen = self.seen(T_world_camera)
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


def orbit_view(film: Film, path: Trajectory, images: int, up: Up | None = None) -> tuple[Film, Matrix]:
    """Return a film without the ceiling, and poses [images, 4, 4] around what its path has seen; up: as in
    `floor_frame`.

    They are so far away that `ENOUGH` of the surfaces are in the image, and at the elevation where the map covers most.
    Where it covers too little from some directions, the camera swings to and fro between the others.
    """
    samples = list(sample_surfaces(film.field, path, film.camera, film.renderer, SURFACE_VIEWS))
    T = floor_frame(samples, up)
    ceiling_m = float(np.median(path.T_world_camera[:, :3, 3] @ T[2, :3] + T[2, 3])) + CEILING_M
    points = np.concatenate([sample.points for sample in samples]) @ T[:3, :3].T + T[:3, 3]
    points = points[(points[:, 2] < ceiling_m) | (points[:, 2].min() >= ceiling_m)]
    below = torch.from_numpy(film.field.means.numpy().astype(np.float64) @ T[2, :3] + T[2, 3] < ceiling_m)
    seen_from = None if film.seen_from is None else film.seen_from[below]
    film = replace(film, field=film.field.part(below), seen_from=seen_from)
    points = points[:: max(1, len(points) // POINTS)].astype(np.float64)
    return film, se3.inverse(T) @ _orbit_around(points, film, se3.inverse(T), images)


def _orbit_around(points: Matrix, film: Film, T_world_floor: Matrix, images: int) -> Matrix:
    """Return T_floor_camera [images, 4, 4] of an orbit that shows points [P, 3] in the frame of the floor."""
    camera = film_camera(film.camera, WIDTH_PX)
    small, turn = replace(film, camera=camera), 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    center, (_, ahead, up) = np.median(points, axis=0), np.eye(3)
    most, best = -1.0, np.empty((0, 4, 4))
    for elevation_rad in ORBIT_ELEVATIONS_RAD:
        local = (points - center) @ orbit(center, up, ahead, 1.0, turn, elevation_rad)[:, :3, :3]
        beside = np.maximum(
            np.abs(local[..., 0]) * 2.0 * camera.fx / camera.width,
            np.abs(local[..., 1]) * 2.0 * camera.fy / camera.height,
        )
        radius_m = max(float(np.quantile(beside - local[..., 2], ENOUGH)), 0.1)
        circle = T_world_floor @ orbit(center, up, ahead, radius_m, turn, elevation_rad)
        covered = np.array([float((small.seen(T).alpha > COVERED_ALPHA).float().mean()) for T in circle])
        angles_rad, share = swing(covered, images)
        if share > most:
            most, best = share, orbit(center, up, ahead, radius_m, angles_rad, elevation_rad)
    return best


def swing(covered: Matrix, images: int) -> tuple[Matrix, float]:
    """Return the angles [images] of a film, and the mean share of covered pixels [D] over them: a full turn, or to and
    fro over the directions around the best one that have at least `ENOUGH` of its share."""
    count, first = len(covered), int(covered.argmax())
    good, last = covered >= ENOUGH * covered.max(), first
    while last - first < count - 1 and good[(last + 1) % count]:
        last += 1
    while last - first < count - 1 and good[(first - 1) % count]:
        first -= 1
    time = 2.0 * np.pi * np.arange(images) / images
    if last - first < count - 1:
        time = 2.0 * np.pi / count * ((first + last) / 2.0 + max(last - first, 1) / 2.0 * np.sin(time))
    return time, float(covered[np.arange(first, last + 1) % count].mean())


CODEC, ENDING = "vp09", ".mp4"


def write_video(path: Path, images: Iterable[Rgb], fps: float) -> None:
    """Write images uint8 RGB [H, W, 3] of equal size as an MP4 file with VP9, atomically.

    VP9 needs even sizes: an odd last row or column is dropped. Raises RunError on another ending, an unwritable file or
    a missing codec.
    """
    if path.suffix.lower() != ENDING:
        raise RunError(f"cannot write a video as {path.name}; give a name that ends in {ENDING}")
    with api.replacing(path) as temporary:
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
