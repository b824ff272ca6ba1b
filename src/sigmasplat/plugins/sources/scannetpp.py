"""Read ScanNet++ scenes: undistorted DSLR photographs, depth rendered from the laser scan.

dslr/nerfstudio/transforms_undistorted.json     `frames` and `test_frames` (see `files/transforms.py`)
dslr/undistorted_images/DSC00001.JPG            from the data set's toolbox, `dslr.undistort`
dslr/undistorted_depths/DSC00001.png            16 bits, mm, rendered, undistorted (Nik-V9/scannetpp)
dslr/train_test_lists.json                      optional {"train": […], "test": […]}: names in order

The sequence contains the training photographs. The test photographs are not taken along the path, so they cannot be
tracked: `test_views()` returns them with their poses. SplaTAM and similar systems read the same layout.
"""

from pathlib import Path

from sigmasplat.config import InputConfig
from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import MM_PER_METRE, read_json_object, resolve_calibration
from sigmasplat.input.folders import FRAMES_PER_SECOND
from sigmasplat.input.pose_files import build_trajectory
from sigmasplat.input.recorded import ImagePair, RecordedSource, first_size
from sigmasplat.input.transforms import Fields, read_camera, read_frames, read_pose
from sigmasplat.registry import SourceFormat

TRANSFORMS = Path("nerfstudio") / "transforms_undistorted.json"
IMAGES, DEPTHS, LISTS = "undistorted_images", "undistorted_depths", "train_test_lists.json"


def open_scannetpp(scene: Path, settings: InputConfig) -> RecordedSource:
    """Open a scene's folder or its `dslr`. Raises SourceError if its JSON file, images or camera cannot be used."""
    dslr = _dslr(scene)
    fields = read_json_object(dslr / TRANSFORMS)
    _refuse_missing_folders(dslr)
    views = _chosen(dslr, fields, "test", "test_frames") if fields.get("test_frames") else []
    views = [view for view in views if (dslr / IMAGES / view["file_path"]).is_file()]
    test = _source(dslr, fields, views, settings) if views else None
    return _source(dslr, fields, _chosen(dslr, fields, "train", "frames"), settings, test)


def _source(
    dslr: Path, fields: Fields, frames: list[Fields], settings: InputConfig, test: RecordedSource | None = None
) -> RecordedSource:
    path, scene = dslr / TRANSFORMS, dslr.resolve().parent
    files = [(dslr / IMAGES / f["file_path"], (dslr / DEPTHS / f["file_path"]).with_suffix(".png")) for f in frames]
    images = [ImagePair(i / FRAMES_PER_SECOND, *pair) for i, pair in enumerate(files)]
    size = first_size([color for color, _ in files])
    camera = read_camera(path, fields, frames, size, MM_PER_METRE)
    calibration = resolve_calibration(scene, camera, size, settings, MM_PER_METRE)
    truth = build_trajectory((i.timestamp_s, read_pose(path, frame)) for i, frame in zip(images, frames, strict=True))
    return RecordedSource(scene.name, images, calibration, settings, truth, test=test)


def _chosen(dslr: Path, fields: Fields, split: str, key: str) -> list[Fields]:
    """Return the frames of a split, in the order of train_test_lists.json if it exists, else of their names."""
    frames = {frame["file_path"]: frame for frame in read_frames(dslr / TRANSFORMS, fields, key)}
    lists = read_json_object(dslr / LISTS) if (dslr / LISTS).is_file() else {}
    names = lists.get(split, sorted(frames))
    if not isinstance(names, list) or not names:
        raise SourceError(f"{dslr / LISTS}: {split!r} is {str(names)[:60]}, expected a list of file names")
    absent = [str(name) for name in names if str(name) not in frames]
    if absent:
        raise SourceError(f"{dslr / LISTS}: {absent[0]} of {split!r} is not among the {key} of {TRANSFORMS.name}")
    return [frames[name] for name in names]


def _refuse_missing_folders(dslr: Path) -> None:
    for part, made_by in ((IMAGES, "the toolbox's `python -m dslr.undistort`"), (DEPTHS, "a depth renderer")):
        if not (dslr / part).is_dir():
            there = ", ".join(sorted(entry.name for entry in dslr.iterdir() if entry.is_dir()))
            raise SourceError(
                f"{dslr}: no {part}/ (found {there}); create it with {made_by}, for the undistorted camera"
            )


def _dslr(scene: Path) -> Path:
    return scene if (scene / TRANSFORMS).is_file() else scene / "dslr"


PLUGIN = SourceFormat(
    "ScanNet++",
    "dslr/nerfstudio/",
    lambda path: (_dslr(Path(path)) / TRANSFORMS).is_file(),
    lambda path, settings: open_scannetpp(Path(path), settings),
)
