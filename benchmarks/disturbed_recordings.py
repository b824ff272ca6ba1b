"""Write disturbed recordings as folders that any SigmaSplat reads: TUM layout, full size, without ground truth."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import record
from disturbances import Color, Plan, disturbed
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.data.camera import Camera
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.input.source import Source
from sigmasplat.plugins.checks.motion import times_of
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.plugins.sources import open_source

FRAMES_PER_SECOND = 30.0
"""Frame i of every disturbed recording has the time i / 30 s: times do not reveal what was cut out."""
UNITS_PER_METRE, UINT16_MAX = 5000, 65535
QUANTILE_FRAMES = 10


@dataclass(frozen=True, eq=False)
class Original:
    """The frames of a recording that have a true pose, read from disk one by one.

    color: uint8 [N, H, W, 3] and depth: uint16 [N, H, W], 1/5000 m, of all frames; frames [K]: those with a true pose;
    T_world_camera [K, 4, 4]: their true poses.
    """

    name: str
    camera: Camera
    color: Color
    depth: NDArray[np.uint16]
    frames: NDArray[np.intp]
    T_world_camera: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.frames)

    def color_of(self, index: int) -> Color:
        """Return the colour of a frame with a true pose."""
        return self.color[self.frames[index]]

    def depth_m(self, index: int) -> NDArray[np.float32]:
        """Return the depth of a frame with a true pose, m, 0 = no reading."""
        return np.asarray(self.depth[self.frames[index]] / np.float32(UNITS_PER_METRE), np.float32)

    @cached_property
    def _readings_m(self) -> NDArray[np.float32]:
        """Sorted readings of some frames, m."""
        some = np.unique(np.linspace(0, len(self) - 1, QUANTILE_FRAMES).astype(int))
        depth = np.concatenate([self.depth_m(i)[::4, ::4].ravel() for i in some])
        return np.sort(depth[depth > 0])

    def depth_quantile(self, share: float) -> float:
        """Return the depth, m, that this share of the readings is nearer than."""
        return float(np.quantile(self._readings_m, share))


def with_truth(path: str, start_s: float, limit: int = 0) -> tuple[Source, Trajectory, int]:
    """Open a recording or a synthetic room from `start_s` seconds on, with its true path and the number of its frames
    that have a true pose. No image is decoded. Raises SourceError if it cannot be read or has no true pose."""
    source = open_source(path, InputConfig(start_s=start_s, limit=limit))
    truth = source.truth()
    if truth is None:
        raise SourceError(f"{path}: the true path is unknown, so nothing can be scored")
    frames = associate(times_of(source), truth.timestamps_s)[0]
    if not len(frames):
        raise SourceError(f"{path}: no frame has a true pose, so nothing can be scored")
    return source, truth, len(frames)


def original(path: str, start_s: float, folder: Path, limit: int = 0) -> Original:
    """Open the frames of a recording or a synthetic room that have a true pose, from `start_s` seconds on.

    Its decoded frames are kept in `folder`, and read from there the next time. Raises SourceError if it cannot be read
    or has no true pose.
    """
    source, truth, _ = with_truth(path, start_s, limit)
    stem = folder / record.slug(f"{path} {start_s:g}{f' {limit}' if limit else ''}")
    color_path, depth_path, times_path = (stem.with_suffix(f".{part}.npy") for part in ("color", "depth", "times"))
    if not times_path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        size = (len(source), source.camera.height, source.camera.width)
        color = np.lib.format.open_memmap(color_path, "w+", np.uint8, (*size, 3))
        depth = np.lib.format.open_memmap(depth_path, "w+", np.uint16, size)
        times_s = np.full(len(source), np.nan)  # of a frame that cannot be read
        for frame in source:
            units = np.rint(frame.depth_m * UNITS_PER_METRE)
            depth[frame.index] = np.where(units < UINT16_MAX, units, 0)
            color[frame.index] = np.rint(frame.color * 255.0)
            times_s[frame.index] = frame.timestamp_s
        color.flush()
        depth.flush()
        np.save(times_path, times_s)  # written last: the other two are complete
    times_s = np.load(times_path)
    read = np.flatnonzero(np.isfinite(times_s))
    rows, truth_rows = associate(times_s[read], truth.timestamps_s)
    images, poses = (np.load(color_path, "r"), np.load(depth_path, "r")), truth.T_world_camera[truth_rows]
    return Original(source.name, source.camera, *images, read[rows], poses)


def write(from_: Original, planned: Plan, name: str, severity: int, seed: int, folder: Path) -> None:
    """Write a disturbed recording to a new folder: rgb/*.bmp, depth/*.npy, their lists, calibration.json."""
    for part in ("rgb", "depth"):
        (folder / part).mkdir(parents=True)
    calibration = asdict(from_.camera) | {"depth_scale": UNITS_PER_METRE}
    (folder / "calibration.json").write_text(json.dumps(calibration) + "\n")
    for index in range(len(planned)):
        images = from_.color_of(planned.color[index]), from_.depth_m(planned.depth[index])
        color, depth = disturbed(name, severity, seed, planned, index, *images, from_.depth_quantile)
        cv2.imwrite(str(folder / f"rgb/{index:06d}.bmp"), color[..., ::-1])
        units = np.minimum(np.rint(depth * UNITS_PER_METRE), UINT16_MAX - 1)
        np.save(folder / f"depth/{index:06d}.npy", units.astype(np.uint16))
    _write_list(folder / "rgb.txt", len(planned), lambda i: f"rgb/{i:06d}.bmp")
    _write_list(folder / "depth.txt", len(planned), lambda i: f"depth/{i:06d}.npy")


def _write_list(path: Path, frames: int, name: Callable[[int], str]) -> None:
    path.write_text("".join(f"{i / FRAMES_PER_SECOND:.6f} {name(i)}\n" for i in range(frames)))
