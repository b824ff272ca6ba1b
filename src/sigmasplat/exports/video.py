"""Render a run as a film: colour, depth and uncertainty side by side, along its own path or in a circle above it."""

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from PIL import Image

from sigmasplat.drawing.colormap import Rgb
from sigmasplat.drawing.film import FilmMaps, FilmScale, film_image, legend_strip
from sigmasplat.env import install_extra
from sigmasplat.errors import BackendError, ConfigError, RunError
from sigmasplat.exports.recorded import Recorded
from sigmasplat.floorplan.ground import floor_frame
from sigmasplat.floorplan.surface_samples import SurfaceRenderer, sample_surfaces
from sigmasplat.io.atomic import replacing
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
    renderer: SurfaceRenderer | None = None,
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
    field: GaussianField, path: Trajectory, camera: Camera, images: int, renderer: SurfaceRenderer
) -> tuple[GaussianField, Matrix]:
    """Return the map without its ceiling, and a circle of poses [images, 4, 4] above it that keeps it in view."""
    sights = list(sample_surfaces(field, path, camera, renderer, LOOKS))
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


def _show(renderer: SurfaceRenderer, field: GaussianField, camera: Camera, T_world_camera: Matrix) -> FilmMaps:
    with torch.inference_mode():
        return FilmMaps.of(renderer(field, camera, se3.inverse(T_world_camera)))


def _images(show: Callable[[Matrix], FilmMaps], poses: Matrix, width: int, progress: Progress) -> Iterator[Rgb]:
    """Yield a film's images, their colours fixed by a few of them."""
    rows = np.unique(np.linspace(0, len(poses) - 1, min(SAMPLES, len(poses))).round().astype(int))
    scale = FilmScale.of([show(poses[row]) for row in rows])
    strip = legend_strip(scale, width)
    for done, pose in enumerate(poses, 1):
        yield film_image(show(pose), scale, strip)
        progress(done, len(poses))


CODECS = {".webm": "VP90", ".mp4": "vp09"}
PICTURES = {".gif": "GIF", ".webp": "WEBP"}
ENDINGS = (*CODECS, *PICTURES)
NO_IMAGES = "a film needs at least one image, found none"


def write_video(path: Path, images: Iterable[Rgb], fps: float) -> None:
    """Write images uint8 RGB [H, W, 3], all of one size, as a film, as its name's ending says, in one step.

    Raises RunError on another ending, an unwritable place or where the codec is not there; BackendError without OpenCV.
    """
    check_name(path)
    kind = path.suffix.lower()
    with replacing(path) as temporary:
        scratch = temporary.with_suffix(kind)  # OpenCV goes by the ending
        try:
            if kind in CODECS:
                _write_vp9(scratch, images, fps, CODECS[kind])
            else:
                _write_pictures(scratch, iter(images), fps, PICTURES[kind])
            os.replace(scratch, temporary)
        finally:
            scratch.unlink(missing_ok=True)


def check_name(path: Path) -> None:
    """Raise RunError unless a film can be written under this name, BackendError where OpenCV is missing for it."""
    if path.suffix.lower() not in ENDINGS:
        raise RunError(f"cannot write a film as {path.name}; give a name that ends in {', '.join(ENDINGS)}")
    if path.suffix.lower() in CODECS:
        _opencv()


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as problem:
        raise BackendError(
            f"films as .webm and .mp4 need OpenCV: {install_extra('video')}; or write .gif or .webp"
        ) from problem
    return cv2


def _write_vp9(path: Path, images: Iterable[Rgb], fps: float, codec: str) -> None:
    """Encode with VP9; odd sizes, which it cannot halve, lose their last row or column."""
    cv2, writer, size = _opencv(), None, (0, 0)
    try:
        for image in images:
            if writer is None:
                size = (image.shape[1] // 2 * 2, image.shape[0] // 2 * 2)
                with _quiet():
                    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*codec), fps, size)
                if not writer.isOpened():
                    raise RunError(
                        f"cannot write {path.name} with this OpenCV; write .gif or .webp, or a writable place"
                    )
            writer.write(np.ascontiguousarray(image[: size[1], : size[0], ::-1]))
    finally:
        if writer is not None:
            writer.release()
    if writer is None:
        raise RunError(NO_IMAGES)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the process's standard error silent: OpenCV warns there of a tag in .webm that it mends itself."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _write_pictures(path: Path, images: Iterator[Rgb], fps: float, kind: str) -> None:
    """Write an animation that repeats."""
    first = next(images, None)
    if first is None:
        raise RunError(NO_IMAGES)
    rest = (Image.fromarray(image) for image in images)
    duration_ms = round(1000.0 / fps)
    options = {"quality": 80} if kind == "WEBP" else {}
    Image.fromarray(first).save(
        path, kind, save_all=True, append_images=rest, duration=duration_ms, loop=0, **options
    )  # fmt: skip
