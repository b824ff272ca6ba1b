"""Read the Replica renderings in the layout of NICE-SLAM.

results/frame000000.jpg  results/depth000000.png  traj.txt     one row-major camera-to-world 4×4 per line
cam_params.json                                                here or in the parent folder
../room0_mesh.ply                                              optional: the true surface, named after the folder
"""

import re
from pathlib import Path

import numpy as np

from sigmasplat.config import InputConfig
from sigmasplat.data import se3
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.files.reading import exists, read_text
from sigmasplat.input.calibration import REPLICA, Calibration, read_replica_calibration, resolve_calibration
from sigmasplat.input.images import FRAMES_PER_SECOND, pair_images
from sigmasplat.input.recorded import ImagePair, RecordedSource
from sigmasplat.registry import SourceFormat


def open_replica(folder: Path, settings: InputConfig) -> RecordedSource:
    """Open a folder. Raises SourceError if images, calibration or ground-truth poses cannot be used."""
    colors, depths = _numbered(folder, "frame"), _numbered(folder, "depth")
    numbers, skipped = pair_images(folder, colors, depths, "results/frame*.jpg", "results/depth*.png")
    images = [ImagePair(n / FRAMES_PER_SECOND, colors[n], depths[n]) for n in numbers]
    recorded = _calibration(folder)
    size = (recorded.camera.width, recorded.camera.height)
    calibration = resolve_calibration(folder, recorded, size, settings, recorded.depth_units_per_metre)
    truth = _truth(folder / "traj.txt", numbers)
    name, surface = folder.resolve().name, _surface(folder.resolve())
    return RecordedSource(name, images, calibration, settings, truth, skipped, surface=surface)


def _numbered(folder: Path, stem: str) -> dict[int, Path]:
    """Map the number in the name of each `results/<stem>NNN.*` image to its path."""
    found = {}
    for path in sorted((folder / "results").glob(f"{stem}*")):
        match = re.fullmatch(rf"{stem}(\d+)\.(jpg|jpeg|png|npy|tiff?)", path.name.lower())
        if match:
            found[int(match.group(1))] = path
    return dict(sorted(found.items()))


def _calibration(folder: Path) -> Calibration:
    for path in (folder / "cam_params.json", folder.resolve().parent / "cam_params.json"):
        if path.is_file():
            return read_replica_calibration(path)
    return REPLICA


def _surface(folder: Path) -> Path | None:
    """Return the file of the true surface, in the parent folder or here; None without one."""
    files = (place / f"{folder.name}_mesh.ply" for place in (folder.parent, folder))
    return next((path for path in files if path.is_file()), None)


def _truth(path: Path, numbers: list[int]) -> Trajectory | None:
    """Read the poses of the given frames. Raises SourceError naming the line whose pose is not rigid."""
    if not exists(path):
        return None
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    if numbers[-1] >= len(lines):
        raise SourceError(
            f"{path}: {len(lines)} poses, but the last image has number {numbers[-1]}; is the file truncated?"
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
            f"{where}: expected 16 numbers (row-major camera-to-world), found {line.strip()[:80]!r}"
        ) from error


PLUGIN = SourceFormat(
    "Replica",
    "results/frame*.jpg and results/depth*.png",
    lambda path: bool(_numbered(Path(path), "frame") or _numbered(Path(path), "depth")),
    lambda path, settings: open_replica(Path(path), settings),
)
