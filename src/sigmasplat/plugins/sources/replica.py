"""Read the Replica renderings in the layout of NICE-SLAM.

results/frame000000.jpg  results/depth000000.png  traj.txt     one row-major camera-to-world 4×4 per line
cam_params.json                                                here or in the parent folder
../room0_mesh.ply                                              optional: the true surface, named after the folder
"""

import re
from dataclasses import replace
from pathlib import Path

import sigmasplat.api as api
from sigmasplat.api import SourceError

CAMERA = api.published("that of Replica's renders", api.Camera(1200, 680, 600.0, 600.0, 599.5, 339.5), 6553.5)


def open_replica(path: str, settings: api.InputConfig) -> api.RecordedSource:
    """Open a folder. Raises SourceError if images, calibration or ground-truth poses cannot be used."""
    folder, place = Path(path), Path(path).resolve()
    colors, depths = _numbered(folder, "frame"), _numbered(folder, "depth")
    images, skipped = api.numbered_pairs(folder, colors, depths, "results/frame*.jpg", "results/depth*.png")
    beside = api.first_file(folder, ("cam_params.json", place.parent / "cam_params.json"))
    size, units = api.first_size([pair.color for pair in images.values()]), CAMERA.depth_units_per_metre
    if (known := api.read_intrinsics(beside, size, units) if beside else CAMERA) is None:
        raise SourceError(f'{beside}: no "camera" object with w, h, fx, fy, cx, cy, scale')
    surface = api.first_file(place.parent, (f"{place.name}_mesh.ply", place / f"{place.name}_mesh.ply"))
    truth, units = _truth(folder / "traj.txt", [*images]), known.depth_units_per_metre
    return api.folder_source(folder, settings, [*images.values()], known, units, truth, skipped, surface=surface)


def _numbered(folder: Path, stem: str) -> dict[int, Path]:
    """Map the number in the name of each `results/<stem>NNN.*` image to its path."""
    images = api.list_images(folder / "results", (*api.COLOR_ENDINGS, ".npy"))
    return api.index_by_number(path for path in images if re.fullmatch(rf"{stem}\d+", path.stem.lower()))


def _truth(path: Path, numbers: list[int]) -> api.Trajectory | None:
    if not api.exists(path):
        return None
    lines = [line for line in api.read_text(path).splitlines() if line.strip()]
    if numbers[-1] >= len(lines):
        raise SourceError(
            f"{path}: {len(lines)} poses, but the last image has number {numbers[-1]}; is the file truncated?"
        )
    rows = ((n, api.parse_numbers(path, n + 1, lines[n].split())) for n in numbers)
    truth = api.build_trajectory(
        (n / api.FRAMES_PER_SECOND, api.checked_pose(f"{path}:{n + 1}", api.to_matrix(f"{path}:{n + 1}", row)))
        for n, row in rows
    )
    return truth and replace(truth, error_rms=(0.0, 0.0))


PLUGIN = api.SourceFormat(
    "Replica", "results/frame*.jpg and results/depth*.png",
    lambda path: bool(_numbered(Path(path), "frame") or _numbered(Path(path), "depth")), open_replica,
    sensor="rendered",
)  # fmt: skip
