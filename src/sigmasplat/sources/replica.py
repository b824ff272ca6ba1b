"""Read the Replica renderings in the layout NICE-SLAM made common.

results/frame000000.jpg  results/depth000000.png  traj.txt     one row-major camera-to-world 4×4 per line
cam_params.json                                                here or in the parent folder
"""

import re
from pathlib import Path

import numpy as np

from sigmasplat.errors import SourceError
from sigmasplat.model import se3
from sigmasplat.model.frame import Frame
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.sources.base import Source
from sigmasplat.sources.calibration import REPLICA, Calibration, read_replica_calibration
from sigmasplat.sources.depth_check import refuse_without_depth
from sigmasplat.sources.images import color_from_bytes, read_color, read_depth
from sigmasplat.sources.opening import Format

FRAMES_PER_SECOND = 30.0
"""Replica's renderings carry no time; this rate is a convention."""


class ReplicaSource(Source):
    """Colour and depth images paired by the number in their names."""

    def __init__(self, folder: Path, strict: bool = False) -> None:
        """Open a folder; raises SourceError if images, calibration or true poses cannot be used."""
        calibration = _calibration(folder)
        super().__init__(folder.resolve().name, calibration.camera, strict)
        self.depth_units_per_metre: float = calibration.depth_units_per_metre
        colors, depths = _numbered(folder, "frame"), _numbered(folder, "depth")
        if not depths:
            raise SourceError(
                f"no depth images in {folder} (looked for results/depth*.png); is this the RGB-only download?"
            )
        if not colors:
            raise SourceError(f"no colour images in {folder} (looked for results/frame*.jpg, results/frame*.png)")
        self._images = [(n, colors[n], depths[n]) for n in sorted(colors.keys() & depths.keys())]
        if not self._images:
            raise SourceError(
                f"{folder}/results: no number is shared by frame* and depth*; are both from one recording?"
            )
        self.skipped = [f"{colors[n]}: no depth{n:06d}.png beside it" for n in sorted(colors.keys() - depths.keys())]
        self._truth = _truth(folder / "traj.txt", [n for n, _, _ in self._images])
        self._refuse_size_of_first()
        refuse_without_depth(self)

    def __len__(self) -> int:
        return len(self._images)

    def frame(self, i: int) -> Frame:
        """Read frame i; its time is its number at 30 frames per second."""
        number, color_path, depth_path = self._images[self._checked_index(i)]
        color = color_from_bytes(read_color(color_path))
        depth_m = read_depth(depth_path, self.depth_units_per_metre)
        self._refuse_sizes(color_path, color.shape[:2], depth_path, depth_m.shape)
        return Frame(i, number / FRAMES_PER_SECOND, color, depth_m, self.camera)

    def truth(self) -> Trajectory | None:
        """Return the poses of traj.txt for the frames that have images; None without the file."""
        return self._truth

    def _refuse_sizes(
        self, color: Path, color_shape: tuple[int, ...], depth: Path, depth_shape: tuple[int, ...]
    ) -> None:
        wanted = (self.camera.height, self.camera.width)
        for path, shape in ((color, color_shape), (depth, depth_shape)):
            if shape != wanted:
                raise SourceError(
                    f"{path} is {shape[1]}×{shape[0]} but the calibration is for {wanted[1]}×{wanted[0]}; "
                    "give colour and depth one size and put it into cam_params.json"
                )

    def _refuse_size_of_first(self) -> None:
        """Stop before the run where every frame would be refused for its size."""
        _, color_path, depth_path = self._images[0]
        try:
            color_shape, depth_shape = read_color(color_path).shape[:2], read_depth(depth_path, 1.0).shape
        except SourceError:
            return  # damaged: iterating the source reports it
        self._refuse_sizes(color_path, color_shape, depth_path, depth_shape)


def _numbered(folder: Path, stem: str) -> dict[int, Path]:
    """Map the number in each `results/<stem>NNN.*` image to its path."""
    found = {}
    for path in sorted((folder / "results").glob(f"{stem}*")):
        match = re.fullmatch(rf"{stem}(\d+)\.(jpg|jpeg|png|npy|tiff?)", path.name.lower())
        if match:
            found[int(match.group(1))] = path
    return found


def _calibration(folder: Path) -> Calibration:
    for path in (folder / "cam_params.json", folder.resolve().parent / "cam_params.json"):
        if path.is_file():
            return read_replica_calibration(path)
    return REPLICA


def _truth(path: Path, numbers: list[int]) -> Trajectory | None:
    """Read the poses of the numbered frames. Raises SourceError naming the line that is no rigid pose."""
    if not path.is_file():
        return None
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    if numbers[-1] >= len(lines):
        raise SourceError(
            f"{path}: {len(lines)} poses, but images go up to number {numbers[-1]}; is the file cut short?"
        )
    poses = []
    for number in numbers:
        T = _matrix(f"{path}:{number + 1}", lines[number])
        if not se3.is_rigid(T):
            raise SourceError(f"{path}:{number + 1}: not a finite rigid pose: {lines[number].strip()[:80]}")
        poses.append(T)
    return Trajectory(np.array(numbers) / FRAMES_PER_SECOND, np.stack(poses))


def _matrix(where: str, line: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    try:
        return np.array([float(word) for word in line.split()]).reshape(4, 4)
    except ValueError as error:
        raise SourceError(
            f"{where}: 16 numbers (row-major camera-to-world) wanted, found {line.strip()[:80]!r}"
        ) from error


FORMAT = Format(
    "Replica",
    "results/frame*.jpg and results/depth*.png",
    lambda path: bool(_numbered(Path(path), "frame") or _numbered(Path(path), "depth")),
    lambda path, strict: ReplicaSource(Path(path), strict),
)
