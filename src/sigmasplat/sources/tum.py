"""Read and write sequences in the layout of the TUM RGB-D benchmark.

rgb.txt  depth.txt  groundtruth.txt     lines of "t path" or "t tx ty tz qx qy qz qw", comments after #
calibration.json                        ours: fx fy cx cy width height depth_scale [distortion]; wins where present
"""

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.errors import RunError, SourceError
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.frame import Frame
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.sources.association import associate
from sigmasplat.sources.base import Source
from sigmasplat.sources.calibration import TUM_UNITS_PER_METRE, Calibration, freiburg_calibration, read_calibration
from sigmasplat.sources.depth_check import refuse_without_depth
from sigmasplat.sources.images import OVERFLOW, color_from_bytes, image_size, read_color, read_depth
from sigmasplat.sources.lens import Undistortion
from sigmasplat.sources.opening import Format
from sigmasplat.sources.tum_lists import read_list, read_poses

MAX_GAP_S = 0.02
"""Colour and depth of a Kinect at 30 Hz are never further apart; TUM's own tool uses the same number."""


class TumSource(Source):
    """Colour and depth images paired by time; colour and depth undistorted where the lens is known."""

    def __init__(self, folder: Path, strict: bool = False, max_gap_s: float = MAX_GAP_S) -> None:
        """Open a folder; raises SourceError if its lists, images, calibration or true poses cannot be used."""
        color_times_s, self._color_paths = read_list(folder / "rgb.txt")
        depth_times_s, self._depth_paths = _depth_list(folder)
        self._pairs = associate(color_times_s, depth_times_s, max_gap_s)
        if not len(self._pairs):
            raise SourceError(_no_overlap(folder, color_times_s, depth_times_s, max_gap_s))
        self._times_s = color_times_s[self._pairs[:, 0]]
        calibration = _calibration(folder, _agreed_size(self._image_pairs()))
        super().__init__(folder.resolve().name, calibration.camera, strict)
        self.depth_units_per_metre: float = calibration.depth_units_per_metre
        lens = calibration.distortion
        self._undistortion = Undistortion(self.camera, np.array(lens)) if lens else None
        paired = set(self._pairs[:, 0].tolist())
        self.skipped = [
            f"{p}: no depth within {max_gap_s:g} s" for i, p in enumerate(self._color_paths) if i not in paired
        ]
        truth_path = folder / "groundtruth.txt"
        # Read at once: a broken truth should stop the run before it starts, not its evaluation an hour later.
        self._truth = read_poses(truth_path) if truth_path.is_file() else None
        refuse_without_depth(self)

    def __len__(self) -> int:
        return len(self._pairs)

    def frame(self, i: int) -> Frame:
        """Read frame i: colour and depth of one camera, lens taken out."""
        color_path, depth_path = self._image_pair(self._checked_index(i))
        color = color_from_bytes(read_color(color_path))
        depth_m = read_depth(depth_path, self.depth_units_per_metre)
        _refuse_sizes(color_path, color.shape[1::-1], depth_path, depth_m.shape[::-1], self.camera)
        if self._undistortion:
            color, depth_m = self._undistortion.color(color), self._undistortion.depth(depth_m)
        return Frame(i, float(self._times_s[i]), color, depth_m, self.camera)

    def truth(self) -> Trajectory | None:
        """Return the recorded path, all of it, on its own timestamps."""
        return self._truth

    def _image_pair(self, i: int) -> tuple[Path, Path]:
        color, depth = self._pairs[i]
        return self._color_paths[color], self._depth_paths[depth]

    def _image_pairs(self) -> Iterator[tuple[Path, Path]]:
        return (self._image_pair(i) for i in range(len(self._pairs)))


def write_tum(source: Source, folder: str | Path) -> None:
    """Write any source as a TUM folder: PNG images, lists, calibration.json and, where known, the true path.

    Depth keeps 1/5000 m; readings past 13.1 m do not fit 16 bits and become 0 (no reading).
    Raises RunError if the folder already holds a sequence or cannot be written.
    """
    folder = Path(folder)
    if (folder / "rgb.txt").exists():
        raise RunError(f"{folder} already holds a sequence (rgb.txt); give another folder")
    try:
        for part in ("rgb", "depth"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        calibration = asdict(source.camera) | {"depth_scale": TUM_UNITS_PER_METRE}
        (folder / "calibration.json").write_text(json.dumps(calibration, indent=1) + "\n")
        _write_truth(source.truth(), folder / "groundtruth.txt")
        stems = [_write_images(frame, folder) for frame in source]
        for part in ("depth", "rgb"):  # rgb.txt last: a folder that has it is complete
            (folder / f"{part}.txt").write_text("# timestamp path\n" + "".join(f"{s} {part}/{s}.png\n" for s in stems))
    except OSError as error:
        raise RunError(f"cannot write the sequence to {folder} ({error})") from error


def _write_images(frame: Frame, folder: Path) -> str:
    stem = f"{frame.timestamp_s:.6f}"
    units = np.rint(frame.depth_m * TUM_UNITS_PER_METRE)
    depth = np.where(units < OVERFLOW, units, 0).astype(np.uint16)
    color = np.rint(frame.color * 255.0).astype(np.uint8)
    Image.fromarray(color).save(folder / "rgb" / f"{stem}.png", compress_level=1)
    Image.fromarray(depth).save(folder / "depth" / f"{stem}.png", compress_level=1)
    return stem


def _write_truth(truth: Trajectory | None, path: Path) -> None:
    if truth is None:
        return
    lines = ["# timestamp tx ty tz qx qy qz qw\n"]
    for t, T in zip(truth.timestamps_s, truth.T_world_camera, strict=True):
        w, x, y, z = se3.quaternion_from_rotation(T[:3, :3])
        lines.append(f"{t:.6f} " + " ".join(f"{v:.9f}" for v in (*T[:3, 3], x, y, z, w)) + "\n")
    path.write_text("".join(lines))


def _depth_list(folder: Path) -> tuple[NDArray[np.float64], list[Path]]:
    path = folder / "depth.txt"
    if path.is_file():
        times_s, paths = read_list(path)
        if any(p.is_file() for p in paths):
            return times_s, paths
    looked_for = f"the {len(paths)} files of depth.txt" if path.is_file() else "depth.txt"
    raise SourceError(f"no depth images in {folder} (looked for {looked_for}); is this the RGB-only download?")


def _no_overlap(folder: Path, color_s: NDArray[np.float64], depth_s: NDArray[np.float64], max_gap_s: float) -> str:
    spans = [f"{name} {t.min():.3f} … {t.max():.3f} s" for name, t in (("rgb.txt", color_s), ("depth.txt", depth_s))]
    return f"no colour image of {folder} has depth within {max_gap_s:g} s ({', '.join(spans)}); one recording?"


def _agreed_size(pairs: Iterator[tuple[Path, Path]]) -> tuple[int, int]:
    """Return (width, height) of the first pair whose headers can be read."""
    problem: SourceError | None = None
    for color_path, depth_path in pairs:
        try:
            size, depth_size = image_size(color_path), image_size(depth_path)
        except SourceError as error:
            problem = problem or error
            continue
        _refuse_sizes(color_path, size, depth_path, depth_size, None)
        return size
    raise SourceError(f"no pair of colour and depth can be read (first: {problem})")


def _refuse_sizes(
    color: Path, color_size: tuple[int, ...], depth: Path, depth_size: tuple[int, ...], camera: Camera | None
) -> None:
    """Raise SourceError if sizes (width, height) disagree among colour, depth and calibration."""
    if color_size != depth_size:
        raise SourceError(
            f"{color} is {color_size[0]}×{color_size[1]} but {depth} is {depth_size[0]}×{depth_size[1]}; "
            "register depth to colour and give both one size"
        )
    if camera is not None and color_size != (camera.width, camera.height):
        raise SourceError(
            f"{color} is {color_size[0]}×{color_size[1]} but the calibration is for {camera.width}×{camera.height}; "
            "mend calibration.json"
        )


def _calibration(folder: Path, size: tuple[int, int]) -> Calibration:
    path = folder / "calibration.json"
    known = freiburg_calibration(folder)
    if path.is_file():
        found = read_calibration(path, size, TUM_UNITS_PER_METRE)
    elif known is not None:
        found = known
    else:
        raise SourceError(
            f"camera unknown: no calibration.json in {folder} and no freiburg1, 2 or 3 in its name; "
            "write calibration.json with fx, fy, cx, cy, width, height, depth_scale (PNG units per metre)"
        )
    if size != (found.camera.width, found.camera.height):
        raise SourceError(
            f"{folder}: images are {size[0]}×{size[1]} but the calibration is for "
            f"{found.camera.width}×{found.camera.height}; put the right one into calibration.json"
        )
    return found


FORMAT = Format(
    "TUM",
    "rgb.txt and depth.txt",
    lambda path: (Path(path) / "rgb.txt").is_file() or (Path(path) / "depth.txt").is_file(),
    lambda path, strict: TumSource(Path(path), strict),
)
