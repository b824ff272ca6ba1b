"""Read a nerfstudio folder with depth: transforms.json whose frames name colour and depth images.

transforms.json        see `input/transforms.py`; depth_unit_scale_factor is metres per unit, default 0.001
images/…  depths/…     file_path and depth_file_path, relative to the folder, ordered by the numbers in the names

If depth has another size than colour (as on phones), both are assumed to share one camera.
"""

from dataclasses import replace
from pathlib import Path

from sigmasplat.config import InputConfig
from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import Calibration, check_positive, json_number, read_json_object, resolve_calibration
from sigmasplat.input.folders import FRAMES_PER_SECOND, natural_key
from sigmasplat.input.pose_files import build_trajectory
from sigmasplat.input.recorded import ImagePair, RecordedSource, first_size
from sigmasplat.input.transforms import Fields, read_camera, read_frames, read_pose
from sigmasplat.registry import SourceFormat

NAME = "transforms.json"
METRES_PER_UNIT = 0.001
"""nerfstudio's default of depth_unit_scale_factor."""


def open_nerfstudio(folder: Path, settings: InputConfig) -> RecordedSource:
    """Open a folder. Raises SourceError if its JSON file, images or camera cannot be used."""
    path = folder / NAME
    fields = read_json_object(path)
    named = sorted(read_frames(path, fields), key=lambda frame: natural_key(frame["file_path"]))
    frames = [frame for frame in named if isinstance(frame.get("depth_file_path"), str)]
    if not frames:
        raise SourceError(
            f'{path}: no frame has a "depth_file_path"; export depth with the images, see docs/data.md#without-depth'
        )
    skipped = [
        f"{path}: {frame['file_path']} has no depth_file_path"
        for frame in named
        if not isinstance(frame.get("depth_file_path"), str)
    ]
    images = [ImagePair(i / FRAMES_PER_SECOND, *_files(folder, frame)) for i, frame in enumerate(frames)]
    calibration = _calibration(path, fields, frames, images, settings)
    truth = build_trajectory((i.timestamp_s, read_pose(path, frame)) for i, frame in zip(images, frames, strict=True))
    return RecordedSource(folder.resolve().name, images, calibration, settings, truth, skipped, estimated=True)


def _files(folder: Path, frame: Fields) -> tuple[Path, Path]:
    """Return the colour and the depth file of a frame; instant-ngp omits the file ending of colour."""
    color, depth = folder / frame["file_path"], folder / frame["depth_file_path"]
    bare = not color.suffix and not color.is_file()
    return (color.with_suffix(".png") if bare else color), depth


def _calibration(
    path: Path, fields: Fields, frames: list[Fields], images: list[ImagePair], settings: InputConfig
) -> Calibration:
    size, depth_size = first_size([i.color for i in images]), first_size([i.depth for i in images])
    per_unit = json_number(path, fields, "depth_unit_scale_factor", METRES_PER_UNIT)
    units = round(1.0 / check_positive(path, "depth_unit_scale_factor", per_unit), 6)
    known = read_camera(path, fields, frames, size, units)
    if depth_size != size:
        depth_camera = known.camera.resized(*depth_size)
        known = replace(known, depth_camera=depth_camera, depth_distortion=known.distortion)
    return resolve_calibration(path.parent, known, size, settings, units)


PLUGIN = SourceFormat(
    "nerfstudio",
    "transforms.json",
    lambda path: (Path(path) / NAME).is_file(),
    lambda path, settings: open_nerfstudio(Path(path), settings),
)
