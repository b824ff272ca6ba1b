"""Read a nerfstudio folder with depth: transforms.json whose frames name the images.

transforms.json        see `input/transforms.py`; depth_unit_scale_factor is metres per unit, default 0.001
images/…  depths/…     file_path and depth_file_path, relative to the folder, ordered by the numbers in the names

If depth has another size than colour (as on phones), both are assumed to share one camera.
"""

from pathlib import Path

from sigmasplat.api import (
    FRAMES_PER_SECOND,
    Fields,
    ImagePair,
    InputConfig,
    RecordedSource,
    SourceError,
    SourceFormat,
    build_trajectory,
    check_positive,
    first_size,
    folder_source,
    json_number,
    natural_key,
    read_frames,
    read_json_object,
    read_pose,
    read_transforms_camera,
)

NAME = "transforms.json"
METRES_PER_UNIT = 0.001
"""nerfstudio's default of depth_unit_scale_factor."""


def open_nerfstudio(place: str, settings: InputConfig) -> RecordedSource:
    """Open a folder with depth. Raises SourceError if its JSON file, images or camera cannot be used."""
    folder, path = Path(place), Path(place) / NAME
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
    per_unit = json_number(path, fields, "depth_unit_scale_factor", METRES_PER_UNIT)
    units = round(1.0 / check_positive(path, "depth_unit_scale_factor", per_unit), 6)
    known = read_transforms_camera(path, fields, frames, first_size([i.color for i in images]), units)
    truth = build_trajectory((i.timestamp_s, read_pose(path, frame)) for i, frame in zip(images, frames, strict=True))
    return folder_source(folder, settings, images, known, units, truth, skipped, one_camera=True, estimated=True)


def _files(folder: Path, frame: Fields) -> tuple[Path, Path]:
    """Return the colour and the depth file of a frame; instant-ngp omits the file ending of colour."""
    color, depth = folder / frame["file_path"], folder / frame["depth_file_path"]
    bare = not color.suffix and not color.is_file()
    return (color.with_suffix(".png") if bare else color), depth


PLUGIN = SourceFormat("nerfstudio", NAME, lambda path: (Path(path) / NAME).is_file(), open_nerfstudio)
