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
from sigmasplat.errors import SourceError
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.plugins.sources import open_source

FRAMES_PER_SECOND = 30.0
"""Frame i of every disturbed recording has the time i / 30 s: times do not reveal what was cut out."""
UNITS_PER_METRE, UINT16_MAX = 5000, 65535
QUANTILE_FRAMES = 10


@dataclass(frozen=True, eq=False)
class Original:
    """A recording with its true path, read from disk frame by frame.

    color: uint8 [N, H, W, 3]; depth: uint16 [N, H, W], 1/5000 m; T_world_camera: [N, 4, 4], the true poses.
    """

    name: str
    camera: Camera
    color: Color
    depth: NDArray[np.uint16]
    T_world_camera: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.color)

    def depth_m(self, index: int) -> NDArray[np.float32]:
        """Return the depth of a frame, m, 0 = no reading."""
        return np.asarray(self.depth[index] / np.float32(UNITS_PER_METRE), np.float32)

    @cached_property
    def _readings_m(self) -> NDArray[np.float32]:
        """Sorted readings of some frames, m."""
        some = np.unique(np.linspace(0, len(self) - 1, QUANTILE_FRAMES).astype(int))
        depth = np.concatenate([self.depth_m(i)[::4, ::4].ravel() for i in some])
        return np.sort(depth[depth > 0])

    def depth_quantile(self, share: float) -> float:
        """Return the depth, m, that this share of the readings is nearer than."""
        return float(np.quantile(self._readings_m, share))


def original(path: str, start_s: float, folder: Path) -> Original:
    """Open a recording or a synthetic room from `start_s` seconds on.

    Its decoded frames are kept in `folder`, and read from there the next time. Raises SourceError if it cannot be read
    or a frame has no true pose.
    """
    source = open_source(path, InputConfig(start_s=start_s))
    truth = source.truth()
    if truth is None:
        raise SourceError(f"{path}: the true path is unknown, so nothing can be scored")
    stem = folder / record.slug(f"{path} {start_s:g}")
    color_path, depth_path, times_path = (stem.with_suffix(f".{part}.npy") for part in ("color", "depth", "times"))
    if not times_path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        size = (len(source), source.camera.height, source.camera.width)
        color = np.lib.format.open_memmap(color_path, "w+", np.uint8, (*size, 3))
        depth = np.lib.format.open_memmap(depth_path, "w+", np.uint16, size)
        times_s = np.zeros(len(source))
        for frame in source:
            units = np.rint(frame.depth_m * UNITS_PER_METRE)
            depth[frame.index] = np.where(units < UINT16_MAX, units, 0)
            color[frame.index] = np.rint(frame.color * 255.0)
            times_s[frame.index] = frame.timestamp_s
        color.flush()
        depth.flush()
        np.save(times_path, times_s)  # written last: the other two are complete
    rows, truth_rows = associate(np.load(times_path), truth.timestamps_s)
    if len(rows) < len(source):
        raise SourceError(f"{path}: {len(source) - len(rows)} of {len(source)} frames have no true pose")
    poses = truth.T_world_camera[truth_rows]
    return Original(source.name, source.camera, np.load(color_path, "r"), np.load(depth_path, "r"), poses)


def write(from_: Original, planned: Plan, name: str, severity: int, seed: int, folder: Path) -> None:
    """Write a disturbed recording to a new folder: rgb/*.bmp, depth/*.npy, their lists, calibration.json."""
    for part in ("rgb", "depth"):
        (folder / part).mkdir(parents=True)
    calibration = asdict(from_.camera) | {"depth_scale": UNITS_PER_METRE}
    (folder / "calibration.json").write_text(json.dumps(calibration) + "\n")
    for index in range(len(planned)):
        images = from_.color[planned.color[index]], from_.depth_m(planned.depth[index])
        color, depth = disturbed(name, severity, seed, planned, index, *images, from_.depth_quantile)
        cv2.imwrite(str(folder / f"rgb/{index:06d}.bmp"), color[..., ::-1])
        units = np.minimum(np.rint(depth * UNITS_PER_METRE), UINT16_MAX - 1)
        np.save(folder / f"depth/{index:06d}.npy", units.astype(np.uint16))
    _write_list(folder / "rgb.txt", len(planned), lambda i: f"rgb/{i:06d}.bmp")
    _write_list(folder / "depth.txt", len(planned), lambda i: f"depth/{i:06d}.npy")


def _write_list(path: Path, frames: int, name: Callable[[int], str]) -> None:
    path.write_text("".join(f"{i / FRAMES_PER_SECOND:.6f} {name(i)}\n" for i in range(frames)))
