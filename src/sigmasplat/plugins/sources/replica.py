"""Read the Replica renderings in the layout of NICE-SLAM.

results/frame000000.jpg  results/depth000000.png  traj.txt     one row-major camera-to-world 4×4 per line
cam_params.json                                                here or in the parent folder
../room0_mesh.ply                                              optional: the true surface, named after the folder
"""

import re
from dataclasses import replace
from pathlib import Path

from sigmasplat.api import (
    COLOR_ENDINGS,
    FRAMES_PER_SECOND,
    Calibration,
    Camera,
    InputConfig,
    Origin,
    RecordedSource,
    SourceError,
    SourceFormat,
    Trajectory,
    build_camera,
    build_trajectory,
    check_positive,
    checked_pose,
    exists,
    first_file,
    folder_source,
    index_by_number,
    json_number,
    list_images,
    numbered_pairs,
    parse_numbers,
    published,
    read_json_object,
    read_text,
    to_matrix,
)

CAMERA = published("that of Replica's renders", Camera(1200, 680, 600.0, 600.0, 599.5, 339.5), 6553.5)


def open_replica(path: str, settings: InputConfig) -> RecordedSource:
    """Open a folder. Raises SourceError if images, calibration or ground-truth poses cannot be used."""
    folder, place = Path(path), Path(path).resolve()
    colors, depths = _numbered(folder, "frame"), _numbered(folder, "depth")
    images, skipped = numbered_pairs(folder, colors, depths, "results/frame*.jpg", "results/depth*.png")
    beside = first_file(folder, ("cam_params.json", place.parent / "cam_params.json"))
    known = _calibration(beside) if beside else CAMERA
    surface = first_file(place.parent, (f"{place.name}_mesh.ply", place / f"{place.name}_mesh.ply"))
    truth, units = _truth(folder / "traj.txt", [*images]), known.depth_units_per_metre
    return folder_source(folder, settings, [*images.values()], known, units, truth, skipped, surface=surface)


def _numbered(folder: Path, stem: str) -> dict[int, Path]:
    """Map the number in the name of each `results/<stem>NNN.*` image to its path."""
    images = list_images(folder / "results", (*COLOR_ENDINGS, ".npy"))
    return index_by_number(path for path in images if re.fullmatch(rf"{stem}\d+", path.stem.lower()))


def _calibration(path: Path) -> Calibration:
    """Read `cam_params.json`: {"camera": {w, h, fx, fy, cx, cy, scale}}. Raises SourceError."""
    fields = read_json_object(path).get("camera")
    if not isinstance(fields, dict):
        raise SourceError(f'{path}: no "camera" object with w, h, fx, fy, cx, cy, scale')
    w, h, *focal, scale = (json_number(path, fields, key) for key in ("w", "h", "fx", "fy", "cx", "cy", "scale"))
    read = Origin("", f"read from {path.name}")
    return Calibration(
        build_camera(path, int(w), int(h), focal), check_positive(path, "scale", scale),
        origins={"camera": read, "depth unit": read},
    )  # fmt: skip


def _truth(path: Path, numbers: list[int]) -> Trajectory | None:
    if not exists(path):
        return None
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    if numbers[-1] >= len(lines):
        raise SourceError(
            f"{path}: {len(lines)} poses, but the last image has number {numbers[-1]}; is the file truncated?"
        )
    rows = ((n, parse_numbers(path, n + 1, lines[n].split())) for n in numbers)
    truth = build_trajectory(
        (n / FRAMES_PER_SECOND, checked_pose(f"{path}:{n + 1}", to_matrix(f"{path}:{n + 1}", row))) for n, row in rows
    )
    return truth and replace(truth, error_rms=(0.0, 0.0))


PLUGIN = SourceFormat(
    "Replica", "results/frame*.jpg and results/depth*.png",
    lambda path: bool(_numbered(Path(path), "frame") or _numbered(Path(path), "depth")), open_replica,
    sensor="rendered",
)  # fmt: skip
