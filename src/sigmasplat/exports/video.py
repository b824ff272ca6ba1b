"""Render a run as a film: colour, depth and uncertainty side by side, along its own path or in a circle above it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from sigmasplat.errors import ConfigError
from sigmasplat.exports.recorded import Recorded
from sigmasplat.io.video import check_name, write_video
from sigmasplat.metrics.film import Maps, Scale, film_image, legend_strip
from sigmasplat.metrics.floor import floor_frame
from sigmasplat.metrics.palette import Rgb
from sigmasplat.metrics.sights import Renderer, looks
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.camera_path import orbit, resampled
from sigmasplat.model.field import GaussianField
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.render import FieldRenderer
from sigmasplat.types import Matrix, Progress

SHORTEST_S, LONGEST_S, ORBIT_S = 4.0, 60.0, 12.0
SAMPLES = 12
"""Images that the film's scale is fitted to."""
LOOKS = 20
CUT_M = 0.1
"""From above, what lies higher than this over the middle height of the camera is cut off: the ceiling, mostly."""


@dataclass(frozen=True)
class VideoOptions:
    """How a film is made: width_px of each of its three panels (0: that of the run's images), images per second, length
    (None: that of the path, 4 to 60 s; 12 s in a circle), which way the camera goes.

    Raises ConfigError on sizes, rates or lengths that make no film.
    """

    width_px: int = 0
    fps: float = 25.0
    seconds: float | None = None
    path: Literal["run", "orbit"] = "run"

    def __post_init__(self) -> None:
        if not (self.width_px == 0 or 32 <= self.width_px <= 4096):
            raise ConfigError(f"a film's panels must be 32 to 4096 pixels wide, found {self.width_px}")
        if not 1.0 <= self.fps <= 120.0 or not (self.seconds is None or 0.04 <= self.seconds <= 3600.0):
            raise ConfigError(
                f"a film takes 1 to 120 images/s and at most an hour, found {self.fps} and {self.seconds} s"
            )
        if self.path not in ("run", "orbit"):
            raise ConfigError(f"a film goes along 'run' or 'orbit', found {self.path!r}")

    def images(self, path_s: float) -> int:
        """Return how many images the film has, for a path of so many seconds."""
        usual = ORBIT_S if self.path == "orbit" else float(np.clip(path_s, SHORTEST_S, LONGEST_S))
        return max(1, round((self.seconds or usual) * self.fps))


def export_video(
    recorded: Recorded,
    target: Path,
    options: VideoOptions | None = None,
    *,
    renderer: Renderer | None = None,
    progress: Progress = lambda done, total: None,
) -> int:
    """Write a film and return how many images it has; `progress` is told (images done, of how many).

    Raises RunError on a name that is no film's, or without a map or path; BackendError without OpenCV for .webm, .mp4.
    """
    options = options or VideoOptions()
    check_name(target)
    config, path = recorded.config, recorded.trusted_path()
    renderer = renderer or FieldRenderer(config.render, config.backend)
    field, camera = recorded.run.read_map(), sized(recorded.camera, options.width_px)
    count = options.images(float(path.timestamps_s[-1] - path.timestamps_s[0]))
    if options.path == "orbit":
        field, poses = from_above(field, path, camera, count, renderer)
    else:
        poses = resampled(path, count)
    show = partial(_show, renderer, field, camera)
    write_video(target, _images(show, poses, camera.width, progress), options.fps)
    return count


def sized(camera: Camera, width_px: int) -> Camera:
    """Return the camera at another width, both sides even, as films want them."""
    width = (width_px or camera.width) // 2 * 2
    return camera.resized(width, max(2, round(camera.height * width / camera.width / 2) * 2))


def from_above(
    field: GaussianField, path: Trajectory, camera: Camera, images: int, renderer: Renderer
) -> tuple[GaussianField, Matrix]:
    """Return the map without its ceiling, and a circle of poses [images, 4, 4] above it that keeps it in view."""
    sights = list(looks(field, path, camera, renderer, LOOKS))
    T = floor_frame(sights)
    points = np.concatenate([sight.points for sight in sights]) @ T[:3, :3].T + T[:3, 3]
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    cut_m = float(np.median(path.T_world_camera[:, :3, 3] @ T[2, :3] + T[2, 3])) + CUT_M
    middle = np.append((low + high)[:2] / 2.0, min(cut_m, 0.8) / 2.0)
    half_view = np.arctan(min(camera.width / camera.fx, camera.height / camera.fy) / 2.0)
    radius_m = 0.85 * float(np.linalg.norm((high - low)[:2]) / 2.0 / np.sin(half_view))
    T_world_floor = se3.inverse(T)
    center = T_world_floor[:3, :3] @ middle + T_world_floor[:3, 3]
    kept = field.moved(torch.eye(4))  # a copy
    kept.keep(torch.from_numpy(field.means.numpy().astype(np.float64) @ T[2, :3] + T[2, 3] < cut_m))
    return kept, orbit(center, T[2, :3], T[1, :3], radius_m, images)


def _show(renderer: Renderer, field: GaussianField, camera: Camera, T_world_camera: Matrix) -> Maps:
    with torch.inference_mode():
        return Maps.of(renderer(field, camera, se3.inverse(T_world_camera)))


def _images(show: Callable[[Matrix], Maps], poses: Matrix, width: int, progress: Progress) -> Iterator[Rgb]:
    """Yield a film's images, their colours fixed by a few of them."""
    rows = np.unique(np.linspace(0, len(poses) - 1, min(SAMPLES, len(poses))).round().astype(int))
    scale = Scale.of([show(poses[row]) for row in rows])
    strip = legend_strip(scale, width)
    for done, pose in enumerate(poses, 1):
        yield film_image(show(pose), scale, strip)
        progress(done, len(poses))
