"""Disturb RGB-D recordings: the disturbances of Noisy-Replica (arXiv 2406.16850) and a few more, three severities each.

Everything random depends on the seed, the name of the disturbance, the severity and the number of the frame only.
Colour is uint8 [H, W, 3]; depth is float32 [H, W] in metres, 0 = no reading; both at the full size of the recording.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray

Color = NDArray[np.uint8]
Depth = NDArray[np.float32]
BEGIN = (0.35, 0.5)
"""An event begins in this part of the frames; the seed chooses where."""
AFTER = 30
"""The number of frames after an event, at least, if the recording has them."""
EDGE_RATIO = 0.05
"""A depth edge: readings of neighbouring pixels that differ by more than this share of the nearer one."""
OBJECT_DEPTH, OBJECT_MIN_DEPTH_M = 0.6, 0.3
"""Depth of the moving object: this share of the depth that a tenth of the readings is nearer than; the least depth."""
BRIGHTNESS_BLOCK = 5
"""The number of frames after which brightness changes again."""


@dataclass(frozen=True)
class Moment:
    """One frame of a disturbed recording: the random numbers of the frame, where it is in the event, and the scene.

    done: the elapsed part of the event, 0 ≤ done < 1, and `since` the frames since it began; seed: the same for all
    frames of the event; depth_quantile: returns the depth, m, that this share of the readings of the recording is
    nearer than.
    """

    random: np.random.Generator
    seed: int
    since: int
    done: float
    depth_quantile: Callable[[float], float]


Change = Callable[[Color, Depth, float, Moment], tuple[Color, Depth]]


def unchanged(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Return the frame itself."""
    return color, depth


def depth_noise(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Add noise to depth, with a standard deviation of `level` z² m at z m."""
    noisy = depth + level * depth**2 * at.random.standard_normal(depth.shape, np.float32)
    return color, np.where(depth > 0, np.maximum(noisy, 0), 0).astype(np.float32)


def shared_noise(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Add noise to depth, with a standard deviation of `level` z² m at z m, that is alike within a few pixels, and
    holes, as of a camera that matches patches of two images."""
    noise, holes = (
        cv2.GaussianBlur(at.random.standard_normal(depth.shape, np.float32), (0, 0), width) for width in (4.0, 8.0)
    )
    noisy = depth + np.float32(level / noise.std()) * depth**2 * noise
    return color, np.where((depth > 0) & (holes < holes.std()), np.maximum(noisy, 0), 0).astype(np.float32)


def coarse_depth(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Return depth of cells of `level` pixels, interpolated between them, as of a phone's laser: edges are soft."""
    size = depth.shape[1] // int(level), depth.shape[0] // int(level)
    cells, read = (cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in (depth, _read(depth)))
    cells = np.where(read > 0, cells / np.maximum(read, 1e-6), 0).astype(np.float32)
    soft, known = (
        cv2.resize(plane, depth.shape[::-1], interpolation=cv2.INTER_LINEAR) for plane in (cells, _read(cells))
    )
    return color, np.where(known > 0.99, soft, 0).astype(np.float32)


def _read(depth: Depth) -> Depth:
    return (depth > 0).astype(np.float32)


def little_contrast(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Return gray colour that keeps a share `level` of the contrast, with noise of one and a half steps."""
    gray = 128.0 + (color - 128.0) * level + at.random.normal(0.0, 1.5, color.shape)
    return np.clip(np.rint(gray), 0, 255).astype(np.uint8), depth


def edge_erosion(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Within `level` pixels of a depth edge, remove half of the readings and average the others with those around."""
    neighbours = np.ones((3, 3), np.uint8)
    far = cv2.dilate(depth, neighbours)
    near = cv2.erode(np.where(depth > 0, depth, np.float32(1e6)), neighbours)
    edge = (far > 0) & (far - near > EDGE_RATIO * near)
    size = 2 * int(level) + 1
    band = (cv2.dilate(edge.astype(np.uint8), np.ones((size, size), np.uint8)) > 0) & (depth > 0)
    valid = cv2.boxFilter((depth > 0).astype(np.float32), -1, (size, size))
    mixed = cv2.boxFilter(depth, -1, (size, size)) / np.maximum(valid, 1e-6)
    removed = at.random.random(depth.shape, np.float32) < 0.5
    return color, np.where(band, np.where(removed, 0, mixed), depth).astype(np.float32)


def missing(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Remove a share `level` of the depth readings, each pixel independently."""
    return color, np.where(at.random.random(depth.shape, np.float32) < level, np.float32(0), depth)


def range_clip(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Remove readings beyond the depth that a share `level` of the readings of the recording is nearer than."""
    return color, np.where(depth > at.depth_quantile(level), np.float32(0), depth)


def blur(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Blur colour along a line of `level` pixels; each frame has a random direction."""
    length = int(level)
    middle, angle = (length - 1) / 2, at.random.uniform(0, np.pi)
    kernel = np.zeros((length, length), np.float32)
    ends = [np.rint(middle + sign * middle * np.array([np.cos(angle), np.sin(angle)])).astype(int) for sign in (-1, 1)]
    cv2.line(kernel, ends[0].tolist(), ends[1].tolist(), (1.0,))
    blurred: Any = cv2.filter2D(color, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    return blurred, depth


def color_noise(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Add noise with a standard deviation of `level` to colour in [0, 1]."""
    noisy = color + np.float32(255 * level) * at.random.standard_normal(color.shape, np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), depth


def brightness(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Multiply colour by `level`; a negative level means × 0.4 and × 1.5 in turns of 5 frames."""
    gain = level if level > 0 else (0.4, 1.5)[at.since // BRIGHTNESS_BLOCK % 2]
    return np.clip(np.rint(color * np.float32(gain)), 0, 255).astype(np.uint8), depth


def black(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Return black colour and no depth, as of a covered camera."""
    return np.zeros_like(color), np.zeros_like(depth)


def moving_object(color: Color, depth: Depth, level: float, at: Moment) -> tuple[Color, Depth]:
    """Put a textured rectangle over a share `level` of the image; it enters on the left and leaves on the right."""
    rows, columns = depth.shape
    height, width = round(rows * level**0.5), round(columns * level**0.5)
    left = round(float(np.interp(at.done, [0, 0.1, 0.9, 1], [-width, 0, columns - width, columns])))
    top = (rows - height) // 2
    coarse = np.random.default_rng((at.seed, 17)).integers(0, 256, (12, 12, 3), np.uint8)
    texture: Any = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    first, last = max(left, 0), min(left + width, columns)
    color, depth = color.copy(), depth.copy()
    if first < last:
        color[top : top + height, first:last] = texture[:, first - left : last - left]
        object_depth_m = max(OBJECT_DEPTH * at.depth_quantile(0.1), OBJECT_MIN_DEPTH_M)
        depth[top : top + height, first:last] = object_depth_m
    return color, depth


@dataclass(frozen=True)
class Disturbance:
    """What changes in a recording, by severity from 1.

    labels: the severities in words; levels: the values for `change`; event_frames: how long the event lasts, empty if
    the disturbance lasts for the whole recording; order: how a level N changes the order of the frames: "" not at all,
    "every": every N-th frame, "late": depth stands still for N frames and is late from then on, "back": after the event
    the camera is N frames ahead, and goes back the way that it would have come.
    """

    title: str
    labels: tuple[str, ...]
    levels: tuple[float, ...]
    change: Change = unchanged
    event_frames: tuple[int, ...] = ()
    order: str = ""


DISTURBANCES = {
    "clean": Disturbance("none", ("–",), (0,)),
    "speed": Disturbance("faster camera", ("×2", "×4", "×8"), (2, 4, 8), order="every"),
    "depth-noise": Disturbance("depth noise, σ / z²", ("0.5 %", "1 %", "2 %"), (0.005, 0.01, 0.02), depth_noise),
    "shared-noise": Disturbance(
        "depth noise of patches, σ / z²", ("0.5 %", "0.8 %", "1.2 %"), (0.005, 0.008, 0.012), shared_noise
    ),
    "coarse-depth": Disturbance("depth of cells", ("2 px", "4 px", "8 px"), (2, 4, 8), coarse_depth),
    "edge-erosion": Disturbance("depth edges eroded", ("1 px", "3 px", "5 px"), (1, 3, 5), edge_erosion),
    "missing": Disturbance("depth missing at random", ("25 %", "50 %", "75 %"), (0.25, 0.5, 0.75), missing),
    "missing-90": Disturbance(
        "90 % of depth missing", ("10 frames", "30 frames", "60 frames"), (0.9,) * 3, missing, (10, 30, 60)
    ),
    "range-clip": Disturbance(
        "readings beyond a range missing", ("25 %", "50 %", "70 %"), (0.75, 0.5, 0.3), range_clip
    ),
    "blur": Disturbance("motion blur", ("7 px", "15 px", "25 px"), (7, 15, 25), blur),
    "color-noise": Disturbance("colour noise, σ", ("0.05", "0.1", "0.2"), (0.05, 0.1, 0.2), color_noise),
    "little-contrast": Disturbance(
        "little contrast", ("15 %", "5 %", "2 %"), (0.15, 0.05, 0.02), little_contrast
    ),
    "brightness": Disturbance(
        "brightness, 30 frames", ("× 0.7", "× 0.4", "× 0.4 / 1.5"), (0.7, 0.4, -1), brightness, (30,) * 3
    ),
    "black": Disturbance("black, no depth", ("5 frames", "20 frames", "40 frames"), (0,) * 3, black, (5, 20, 40)),
    "kidnapped": Disturbance(
        "kidnapped: black + skipped", ("5 + 20", "15 + 60", "20 + 100"), (20, 60, 100), black, (5, 15, 20), "back"
    ),
    "desync": Disturbance(
        "depth late", ("2 frames", "5 frames", "10 frames"), (2, 5, 10), unchanged, (2, 5, 10), "late"
    ),
    "moving-object": Disturbance(
        "object in front", ("10 %, 20 frames", "30 %, 40 frames", "50 %, 80 frames"), (0.1, 0.3, 0.5), moving_object,
        (20, 40, 80),
    ),
}  # fmt: skip
"""All disturbances by name, in the order of the tables."""


@dataclass(frozen=True)
class Plan:
    """The frames of a disturbed recording: the numbers of the original frames whose colour and depth they show.

    The event covers the frames begin ≤ i < end; begin = end = 0 without an event.
    """

    color: NDArray[np.intp]
    depth: NDArray[np.intp]
    begin: int = 0
    end: int = 0

    def __len__(self) -> int:
        return len(self.color)


def plan(name: str, severity: int, seed: int, frames: int, available: int) -> Plan:
    """Choose the frames of a disturbed recording from the `available` ones of the original.

    There are `frames` of them, more if an event needs it, fewer if the original is too short. A camera that goes back
    arrives where it was in the middle between the first frame and the event. Raises ValueError if the original is too
    short to reach the end of the event.
    """
    disturbance = DISTURBANCES[name]
    level = int(disturbance.levels[severity - 1])
    begin = end = 0
    if disturbance.event_frames:
        begin = int(frames * np.random.default_rng((seed, 41)).uniform(*BEGIN))
        end = begin + disturbance.event_frames[severity - 1]
    step = level if disturbance.order == "every" else 1
    color = np.arange(max(frames, end + AFTER if end else 0)) * step
    if disturbance.order == "back":
        color = np.concatenate([np.arange(end), np.arange(min(end + level, available - 1), begin // 2, -1)])
    color = color[color < available]
    if len(color) <= end:
        raise ValueError(f"{available} frames are too few for {name}, severity {severity}, with {frames} frames")
    late = disturbance.order == "late"
    return Plan(color, np.maximum(color - level, np.minimum(color, begin)) if late else color, begin, end)


def disturbed(
    name: str,
    severity: int,
    seed: int,
    planned: Plan,
    index: int,
    color: Color,
    depth: Depth,
    depth_quantile: Callable[[float], float],
) -> tuple[Color, Depth]:
    """Return frame `index` of a plan as the disturbance changes it; the arguments are not modified."""
    disturbance = DISTURBANCES[name]
    if planned.end and not planned.begin <= index < planned.end:
        return color, depth
    random = np.random.default_rng((seed, crc32(name.encode()), severity, index))
    since = index - planned.begin
    done = since / (planned.end - planned.begin) if planned.end else 0.0
    at = Moment(random, seed, since, done, depth_quantile)
    return disturbance.change(color, depth, disturbance.levels[severity - 1], at)
