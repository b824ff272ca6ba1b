"""Render the synthetic room: exact depth and poses, any length and size, the same bytes for the same seed."""

import re
from inspect import signature
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sigmasplat.api as api
from sigmasplat.api import Camera, Frame, Matrix, Mesh, Source, SourceError, SourceFormat, Trajectory, se3
from sigmasplat.plugins.sources.room import capture
from sigmasplat.plugins.sources.room.capture import Image, camera_path
from sigmasplat.plugins.sources.room.corridor import PAINTS, corridor_path, sections, wall_path, wall_sections
from sigmasplat.plugins.sources.room.furnish import mask_of, mover as moving_ball
from sigmasplat.plugins.sources.room.render import RoomScene, build_scene, furnished, render_scene
from sigmasplat.plugins.sources.room.shapes import triangulate
from sigmasplat.plugins.sources.stereo_matching import StereoMatcher

FRAMES_PER_SECOND = 30.0
FOCAL_PER_WIDTH, WIDE_FOCAL_PER_WIDTH = 0.8, 0.5
"""Focal length of a room's and of a corridor's camera: a view of 64° and of 90°."""
AWAY_M, AWAY_RAD = np.array([0.45, 0.25, 0.45]), np.deg2rad([12.0, 40.0, 8.0])
"""Largest motion of a test view from the path, camera x, y, z, and rotation about them."""
CLEARANCE_M = 0.3
MOST_MOVER = 50


class SyntheticRoom(Source):
    """A furnished room (or several), or a corridor, ray-cast frame by frame. docs/data.md describes the options.

    seed: appearance of the room, start of the path and all noise. exposure_change None: in rooms, not in a corridor.
    Scored views and the true surface show the room without the ball (`mover`). Each row is seen from where the path is
    at its time (`late`, `rows`, `depth_rows`). `camera` is the stated one: `focal`, `center_x` and `center_y` off the
    true one of the images. What is wrong with colour and depth is in `room.capture`; `gains` [frames, 3] are true.

    A path with loops to close: frames=720,rooms=2,overrun=20,noise=1,drift=6. A round of 600 frames is a slow pace. The
    way back looks in other directions than the way out, so drift accumulates over a whole round; the last 120 frames
    see the views of the first 120 again. The path error is then 15 to 30 cm, many times that of noise alone, while the
    depths of both visits agree within 2 % nearly everywhere.
    Frame i depends only on these options and on i, not on frames read before.
    """

    def __init__(
        self, frames: int = 200, width: int = 320, height: int = 240, seed: int = 0, noise: bool = False,
        loops: int = 1, exposure_change: bool | None = None, rooms: int = 1, overrun: int = 0, drift: int = 0,
        test_views: int = 0, stereo: int = 0, mover: int = 0, predicted: bool = False, corridor: bool = False,
        wall: int = 0, late: float = 0.0, rows: float = 0.0, depth_rows: float = 0.0, focal: float = 0.0,
        center_x: float = 0.0, center_y: float = 0.0, depth_scale: float = 0.0, depth_offset: float = 0.0,
        falloff: float = 0.0, exposure: float = 0.0, white: float = 0.0,
    ) -> None:  # fmt: skip
        """Compute the camera path, no image yet. Raises SourceError for values out of range."""
        counts = {"frames": frames, "width": width, "height": height, "loops": loops, "rooms": rooms}
        others = {"seed": seed, "overrun": overrun, "drift": drift, "test_views": test_views, "stereo": stereo}
        colors = {"falloff": falloff, "exposure": exposure, "white": white}
        for key, value in (counts | others | colors).items():
            if value < (key in counts):
                raise SourceError(f"synthetic room: {key} must be at least {int(key in counts)}, found {value}")
        for key, value in (colors | {"focal": focal, "depth_scale": depth_scale}).items():
            if not abs(value) < 1:
                raise SourceError(f"synthetic room: {key} is a share of size below 1, found {value}")
        if not 0 <= wall <= len(PAINTS):
            raise SourceError(f"synthetic room: wall is 0 (none) to {len(PAINTS)} ({', '.join(PAINTS)}), found {wall}")
        if corridor and wall:
            raise SourceError("synthetic room: a scene is either a corridor or a wall; leave out corridor or wall")
        if (corridor or wall) and (rooms, loops, overrun, mover) != (1, 1, 0, 0):
            scene = "corridor" if corridor else "wall"
            raise SourceError(f"synthetic room: a {scene} has one way; leave out rooms, loops, overrun and mover")
        if not 0 <= mover <= MOST_MOVER or (mover and rooms > 1):
            raise SourceError(f"synthetic room: mover is 0 to {MOST_MOVER} %, in rooms=1; found {mover}, rooms={rooms}")
        focal_px = (WIDE_FOCAL_PER_WIDTH if corridor else FOCAL_PER_WIDTH) * width
        camera = Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
        stated_px, x, y = focal_px * (1 + focal), camera.cx + center_x, camera.cy + center_y
        super().__init__("synthetic", Camera(width, height, stated_px, stated_px, x, y))
        self._true_camera = camera
        if predicted and stereo:
            raise SourceError("synthetic room: depth is either predicted or from stereo; leave out predicted or stereo")
        if (late, rows, depth_rows) != (0.0, 0.0, 0.0) and (stereo or mover):
            raise SourceError("synthetic room: stereo pairs and the ball are read at once; leave out stereo or mover")
        self._late_s, self._rows_s, self._depth_rows_s = late, rows, depth_rows
        inexact = drift or predicted or self.camera != camera or depth_scale or depth_offset
        self.predicted_depth, self.sensor = predicted, None if inexact else "rendered"
        self._seed, self._noise, self._built = seed, noise, (corridor, wall)
        self._rooms = sections(frames) if corridor else wall_sections(frames) if wall else rooms
        self._drift, self._misread, self._test_views = drift / 1000, (depth_scale, depth_offset), test_views
        self.computed_depth, self._baseline_m = stereo > 0, stereo / 100
        self._matcher = StereoMatcher(self.camera, self._baseline_m) if stereo else None  # knows the stated camera
        self.depth_noise_per_m = self._matcher.noise_per_m if self._matcher else None
        along = corridor_path if corridor else wall_path if wall else None
        path = along(frames, seed) if along else camera_path(frames, loops, rooms, seed, overrun / 100)
        self._T_world_camera = path
        swings = not along if exposure_change is None else exposure_change
        self.gains = capture.camera_gains(len(path), seed, exposure, white, swings and not (exposure or white))
        self._shade = capture.shade(camera, falloff)
        self.mover = moving_ball(path, camera, mover / 100) if mover else None

    def __len__(self) -> int:
        return len(self._T_world_camera)

    def frame(self, i: int) -> Frame:
        """Render frame i; colour has steps of 1/255, as from a camera."""
        color, depth_m = self._exposed(i, self._T_world_camera[self._checked_index(i)])
        if self._drift:
            depth_m = capture.drifted_depth(depth_m, i, self._seed, self._drift)
        if self._noise:
            rng = np.random.default_rng((self._seed, i, 7))
            color, depth_m = capture.measured_color(color, rng), capture.measured_depth(depth_m, self._true_camera, rng)
        if self.predicted_depth:
            depth_m = capture.predicted_depth(depth_m, i, self._seed, np.random.default_rng((self._seed, i, 12)))
        bytes_ = np.rint(color * 255.0).astype(np.uint8)
        if self._matcher:
            depth_m, _ = self._matcher.depth_and_std_m(bytes_, self.right_image(i))
        depth_m = capture.misread_depth(depth_m, *self._misread)
        return Frame(i, self.timestamp_s(i), api.color_from_bytes(bytes_), depth_m, self.camera)

    def right_image(self, i: int) -> NDArray[np.uint8]:
        """Render the right image of the stereo pair of frame i, RGB [H, W, 3], with the exposure of the left one."""
        T_left_right = np.eye(4)
        T_left_right[0, 3] = self._baseline_m
        T_world_right = self._T_world_camera[self._checked_index(i)] @ T_left_right
        color = self._exposed(i, T_world_right)[0]
        if self._noise:
            color = capture.measured_color(color, np.random.default_rng((self._seed, i, 9)))
        return np.asarray(np.rint(color * 255.0), np.uint8)

    def timestamp_s(self, i: int) -> float:
        return self._checked_index(i) / FRAMES_PER_SECOND

    def exact_depth_of(self, i: int) -> NDArray[np.float32]:
        """Return the true depth of frame i."""
        return render_scene(self._scene(i), self._true_camera, self._T_world_camera[self._checked_index(i)])[1]

    def moving_of(self, i: int) -> NDArray[np.bool_]:
        """Return the pixels [H, W] of frame i that show the ball which moves through the room."""
        depth_m = self.exact_depth_of(i)
        if self.mover is None:
            return np.zeros(depth_m.shape, np.bool_)
        return mask_of(self.mover.shape(i), self._true_camera, self._T_world_camera[i], depth_m)

    def _scene(self, i: int) -> RoomScene:
        room = build_scene(self._rooms, self._seed, *self._built)
        return room if self.mover is None else RoomScene([*room.shapes, self.mover.shape(i)], room.lights)

    def test_views(self) -> Source | None:
        """Return exact views (no noise, gain 1) up to 0.7 m and 40° away from the path; None without `test_views`."""
        return self.views_away(self._test_views, AWAY_M, AWAY_RAD) if self._test_views else None

    def views_away(self, count: int, away_m: Matrix, away_rad: Matrix) -> Source:
        """Return exact views (no noise, gain 1) near the path: moved by at most away_m [3] along the axes of the camera
        and rotated by a vector of at most away_rad [3]."""
        scene = build_scene(self._rooms, self._seed, *self._built)
        random = np.random.default_rng((self._seed, 11))
        return _ViewsAway(self._true_camera, scene, random, self._T_world_camera, count, (away_m, away_rad))

    def truth(self) -> Trajectory:
        """Return the exact pose of every frame, in the room's frame (z up)."""
        return Trajectory(np.arange(len(self)) / FRAMES_PER_SECOND, self._T_world_camera.copy(), (0.0, 0.0))

    def true_surface(self) -> Mesh:
        """Return the surfaces of all shapes in the room's frame, including hidden parts."""
        built = furnished(self._rooms, self._seed, *self._built)
        return triangulate([shape for shapes in built for shape in shapes])

    def _exposed(self, i: int, T_world_camera: Matrix) -> tuple[Image, Image]:
        """Return colour and depth of frame i from a pose, before noise."""
        color_at = self._poses_of_rows(i, 0.0, self._rows_s) if self._rows_s else T_world_camera
        color, depth_m = render_scene(self._scene(i), self._true_camera, color_at)
        if self._rows_s or self._late_s or self._depth_rows_s:
            poses = self._poses_of_rows(i, self._late_s, self._depth_rows_s)
            depth_m = render_scene(self._scene(i), self._true_camera, poses)[1]
        return np.clip(color * np.float32(self.gains[i] * self._shade), 0.0, 1.0), depth_m

    def _poses_of_rows(self, i: int, late_s: float, rows_s: float) -> Matrix:
        """Return the poses [H, 4, 4] at which the rows of frame i are read: `late_s` after its time, and one after
        another in `rows_s`. Between frames, and beyond the path's ends, the camera moves along screws."""
        height, path = self.camera.height, self._T_world_camera
        if len(path) == 1:
            return np.repeat(path, height, 0)
        late = late_s + rows_s * ((np.arange(height) + 0.5) / height - 0.5)
        when = i + FRAMES_PER_SECOND * late
        k = np.clip(np.floor(when).astype(int), 0, len(path) - 2)
        return se3.interpolated(path[k], path[k + 1], when - k)


class _ViewsAway(Source):
    """Exact views of the room away from a camera path, in free space: nothing is nearer than `CLEARANCE_M`."""

    def __init__(
        self, camera: Camera, scene: RoomScene, random: np.random.Generator, T_world_path: Matrix, count: int,
        away: tuple[Matrix, Matrix],
    ) -> None:  # fmt: skip
        super().__init__("synthetic test views", camera)
        self._scene, (self._away_m, self._away_rad) = scene, away
        on_path = T_world_path[np.linspace(0, len(T_world_path) - 1, count).round().astype(int)]
        self._images = [self._image_near(T, random) for T in on_path]

    def _image_near(self, T_world_path: Matrix, random: np.random.Generator) -> tuple[Matrix, Image, Image]:
        """Draw poses near one of the path until one is free; return it with its colour and depth."""
        while True:
            T_path_camera = se3.exp(np.concatenate([np.zeros(3), random.uniform(-1, 1, 3) * self._away_rad]))
            T_path_camera[:3, 3] = random.uniform(-1, 1, 3) * self._away_m
            T_world_camera = se3.orthonormalise(T_world_path @ T_path_camera)
            color, depth_m = render_scene(self._scene, self.camera, T_world_camera)
            if depth_m[depth_m > 0].min(initial=np.inf) > CLEARANCE_M and (depth_m > 0).any():
                return T_world_camera, color, depth_m

    def __len__(self) -> int:
        return len(self._images)

    def frame(self, i: int) -> Frame:
        _, color, depth_m = self._images[self._checked_index(i)]
        bytes_ = np.rint(np.clip(color, 0.0, 1.0) * 255.0).astype(np.uint8)
        return Frame(i, i / FRAMES_PER_SECOND, api.color_from_bytes(bytes_), depth_m, self.camera)

    def exact_depth_of(self, i: int) -> Image:
        return self._images[self._checked_index(i)][2]

    def truth(self) -> Trajectory:
        poses = np.stack([T_world_camera for T_world_camera, _, _ in self._images])
        return Trajectory(np.arange(len(self)) / FRAMES_PER_SECOND, poses)


def open_synthetic(text: str) -> SyntheticRoom:
    """Build a room from a path such as "synthetic:frames=200,noise=1". Raises SourceError on other options."""
    options: dict[str, Any] = {}
    for part in filter(None, text.partition(":")[2].split(",")):
        key, equals, value = (word.strip() for word in part.partition("="))
        kind = _OPTIONS.get(key)
        value = value if equals or kind in (int, float) else "1"  # a word alone says yes
        if kind is None or not _NUMBERS[kind is float].fullmatch(value):
            whole, decimal = (", ".join(k for k, of in _OPTIONS.items() if (of is float) == d) for d in (False, True))
            raise SourceError(
                f"synthetic room: unknown option {part!r}; give whole numbers for {whole}; decimals for {decimal}"
            )
        options[key] = kind(value) if kind in (int, float) else bool(int(value))
    return SyntheticRoom(**options)


_OPTIONS = {key: type(option.default) for key, option in signature(SyntheticRoom).parameters.items()}
_NUMBERS = re.compile(r"-?[0-9]+"), re.compile(r"-?[0-9]{1,3}(\.[0-9]{1,9})?")


PLUGIN = SourceFormat(
    "synthetic", "the word 'synthetic'", lambda path: path.partition(":")[0] == "synthetic",
    lambda path, settings: open_synthetic(path), priority=3,
)  # fmt: skip
