"""Read ScanNet scenes extracted from .sens files by SensReader/python, preprocessed ones, and ScanNet++ scenes.

color/0.jpg  depth/0.png  pose/0.txt                         also 000000.jpg
intrinsic/intrinsic_color.txt  intrinsic_depth.txt  extrinsic_color.txt  extrinsic_depth.txt
intrinsics_color.txt  intrinsics_depth.txt                   or in the scene's folder, as in scannet_frames_25k

Depth (640×480, mm) has its own camera. It is registered to colour (1296×968), and the working width is depth's.
Extrinsics transform a common frame to each camera: T_color_depth = E_color · E_depth⁻¹ (as in BundleFusion).
Poses are camera to world, and −inf where tracking was lost: these frames are kept, without ground truth.

Preprocessed scenes, as the code of LoopSplat and VarSplat reads them, have colour at the size of depth:

rgb/frame_00000.png  depth/frame_00000.TIFF     640×480; depth as floats in metres, or whole millimetres
gt_pose.txt                                     TUM's lines, one per frame; the times in them are not used
intrinsic.txt                                   optional: the depth camera's matrix; else that of the code's settings

ScanNet++ has undistorted DSLR photographs, and depth rendered from the laser scan:

dslr/nerfstudio/transforms_undistorted.json     `frames` and `test_frames` (see `input/transforms.py`)
dslr/undistorted_images/DSC00001.JPG            from the data set's toolbox, `dslr.undistort`
dslr/undistorted_depths/DSC00001.png            16 bits, mm, rendered, undistorted (Nik-V9/scannetpp)
dslr/train_test_lists.json                      optional {"train": […], "test": […]}: names in order

The sequence contains the training photographs. The test photographs are not taken along the path, so they cannot be
tracked: `test_views()` returns them with their poses. SplaTAM and similar systems read the same layout.
"""

from pathlib import Path

import numpy as np

import sigmasplat.api as api
from sigmasplat.api import Calibration, Fields, InputConfig, RecordedSource, SourceError, SourceFormat, se3

COLOR_SIZE, DEPTH_SIZE = (1296, 968), (640, 480)
"""Width and height of ScanNet's recordings. The published matrices are for these sizes, even if images are resized."""


def open_scannet(path: str, settings: InputConfig) -> RecordedSource:
    """Open a scene's folder. Raises SourceError if images, cameras or poses cannot be used."""
    folder = Path(path)
    files = _files(folder)
    if not files["color"] and not files["depth"] and (packed := sorted(folder.glob("*.sens"))):
        raise SourceError(
            f"{packed[0]} is not extracted; extract color, depth, pose and intrinsic from it with ScanNet's SensReader"
        )
    images, skipped = api.numbered_pairs(folder, files["color"], files["depth"], "color/*.jpg", "depth/*.png")
    known = _recorded(folder, *(api.first_size([files[kind][n] for n in images]) for kind in ("color", "depth")))
    truth = api.read_pose_files((i.timestamp_s, files["pose"][n]) for n, i in images.items() if n in files["pose"])
    return api.folder_source(folder, settings, [*images.values()], known, api.MM_PER_METRE, truth, skipped)


def _files(folder: Path) -> api.FrameFiles:
    return {
        "color": api.index_by_number(api.list_images(api.first_subfolder(folder, ("color", "rgb")), api.COLOR_ENDINGS)),
        "depth": api.index_by_number(api.list_images(folder / "depth", api.DEPTH_ENDINGS)),
        "pose": api.index_by_number(api.list_images(folder / "pose", (".txt",))),
    }


DEPTH_CAMERA = api.Camera(*DEPTH_SIZE, 577.590698, 578.729797, 318.905426, 242.683609)
PREPROCESSED = api.published("ScanNet's depth camera", DEPTH_CAMERA, api.MM_PER_METRE)


def open_preprocessed(path: str, settings: InputConfig) -> RecordedSource:
    """Open a preprocessed scene's folder. Raises SourceError if images, camera or poses cannot be used."""
    folder = Path(path)
    colors, depths = (
        api.index_by_number(api.list_images(folder / kind, api.DEPTH_ENDINGS)) for kind in ("rgb", "depth")
    )
    images, skipped = api.numbered_pairs(folder, colors, depths, "rgb/*.png", "depth/*.TIFF")
    T_world_camera = api.read_poses(folder / "gt_pose.txt").T_world_camera
    last, count = max(images), len(T_world_camera)
    if last >= count:
        raise SourceError(
            f"{folder / 'gt_pose.txt'}: {count} poses, but the last image has number {last}; is the file truncated?"
        )
    truth = api.build_trajectory((pair.timestamp_s, T_world_camera[n]) for n, pair in images.items())
    K, size = folder / "intrinsic.txt", api.first_size([pair.color for pair in images.values()])
    known = (
        Calibration(_camera(K, api.read_matrix(K), size, DEPTH_SIZE), api.MM_PER_METRE) if K.is_file() else PREPROCESSED
    )
    return api.folder_source(folder, settings, [*images.values()], known, api.MM_PER_METRE, truth, skipped)


def _recorded(folder: Path, size: tuple[int, int], depth_size: tuple[int, int]) -> Calibration | None:
    """Build both cameras from the scene's matrices, None if they are missing. Raises SourceError if one is damaged."""
    names = [f"{part}_{kind}" for part in ("intrinsic", "extrinsic") for kind in ("color", "depth")]
    files = {
        n: api.first_file(folder, (f"intrinsic/{n}.txt", f"{n.replace('_', 's_')}.txt", f"{n}.txt")) for n in names
    }
    found = {name: (path, api.read_matrix(path)) for name, path in files.items() if path}
    if "intrinsic_color" not in found:
        return None
    camera = _camera(*found["intrinsic_color"], size, COLOR_SIZE)
    if "intrinsic_depth" not in found:
        raise SourceError(f"{found['intrinsic_color'][0]}: the depth camera's matrix is missing; extract it too")
    depth_camera = _camera(*found["intrinsic_depth"], depth_size, DEPTH_SIZE)
    ends = [found[name][1] if name in found else np.eye(4) for name in names[2:]]
    if not all(se3.is_rigid(T) for T in ends):
        raise SourceError(f"{folder}: the extrinsics of colour or depth are not rigid; correct or delete them")
    T_color_depth, unit = ends[0] @ se3.inverse(ends[1]), {"depth unit": api.DEFINED}
    more: Fields = {"depth_camera": depth_camera, "T_color_depth": T_color_depth, "origins": unit}
    return Calibration(camera, api.MM_PER_METRE, **more)


def _camera(path: Path, K: api.Matrix, size: tuple[int, int], published: tuple[int, int]) -> api.Camera:
    """Build the camera for images of `size`; if the principal point does not fit it, resize the published camera."""
    own = size if abs(2 * K[0, 2] - size[0]) < 0.2 * size[0] else published
    return api.build_camera(path, *own, [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]).resized(*size)


def _recognises(path: str) -> bool:
    folder = Path(path)
    if any(folder.glob("*.sens")):
        return True
    images = api.first_subfolder(folder, ("color", "rgb", "depth"))
    camera = (folder / "intrinsic").is_dir() or any(folder.glob("intrinsic*_*.txt"))
    return images is not None and (camera or (folder / "pose").is_dir())


TRANSFORMS = Path("nerfstudio") / "transforms_undistorted.json"
IMAGES, DEPTHS, LISTS = "undistorted_images", "undistorted_depths", "train_test_lists.json"


def open_scannetpp(path: str, settings: InputConfig) -> RecordedSource:
    """Open a scene's folder or its `dslr`. Raises SourceError if its JSON file, images or camera cannot be used."""
    dslr = _dslr(Path(path))
    fields = api.read_json_object(dslr / TRANSFORMS)
    for part, made_by in ((IMAGES, "the toolbox's `python -m dslr.undistort`"), (DEPTHS, "a depth renderer")):
        if not (dslr / part).is_dir():
            there = ", ".join(sorted(entry.name for entry in dslr.iterdir() if entry.is_dir()))
            raise SourceError(
                f"{dslr}: no {part}/ (found {there}); create it with {made_by}, for the undistorted camera"
            )
    views = _chosen(dslr, fields, "test", "test_frames") if fields.get("test_frames") else []
    views = [view for view in views if (dslr / IMAGES / view["file_path"]).is_file()]
    test = _source(dslr, fields, views, settings) if views else None
    return _source(dslr, fields, _chosen(dslr, fields, "train", "frames"), settings, test)


def _source(
    dslr: Path, fields: Fields, frames: list[Fields], settings: InputConfig, test: RecordedSource | None = None
) -> RecordedSource:
    path, scene = dslr / TRANSFORMS, dslr.resolve().parent
    files = [(dslr / IMAGES / f["file_path"], (dslr / DEPTHS / f["file_path"]).with_suffix(".png")) for f in frames]
    images = [api.ImagePair(i / api.FRAMES_PER_SECOND, *pair) for i, pair in enumerate(files)]
    size = api.first_size([color for color, _ in files])
    known = api.read_transforms_camera(path, fields, frames, size, api.MM_PER_METRE)
    truth = api.build_trajectory(
        (i.timestamp_s, api.read_pose(path, frame)) for i, frame in zip(images, frames, strict=True)
    )
    return api.folder_source(scene, settings, images, known, api.MM_PER_METRE, truth, test=test)


def _chosen(dslr: Path, fields: Fields, split: str, key: str) -> list[Fields]:
    """Return the frames of a split, in the order of train_test_lists.json if it exists, else of their names."""
    frames = {frame["file_path"]: frame for frame in api.read_frames(dslr / TRANSFORMS, fields, key)}
    lists = api.read_json_object(dslr / LISTS) if (dslr / LISTS).is_file() else {}
    names = lists.get(split, sorted(frames))
    if not isinstance(names, list) or not names:
        raise SourceError(f"{dslr / LISTS}: {split!r} is {str(names)[:60]}, expected a list of file names")
    absent = [str(name) for name in names if str(name) not in frames]
    if absent:
        raise SourceError(f"{dslr / LISTS}: {absent[0]} of {split!r} is not among the {key} of {TRANSFORMS.name}")
    return [frames[name] for name in names]


def _dslr(scene: Path) -> Path:
    return scene if (scene / TRANSFORMS).is_file() else scene / "dslr"


PLUGIN = (
    SourceFormat("ScanNet", "color/, depth/ and pose/", _recognises, open_scannet, sensor="kinect-v1"),
    SourceFormat(
        "preprocessed ScanNet", "rgb/, depth/*.TIFF and gt_pose.txt",
        lambda path: (Path(path) / "gt_pose.txt").is_file() and (Path(path) / "rgb").is_dir(),
        open_preprocessed, sensor="kinect-v1",
    ),
    SourceFormat(
        "ScanNet++", "dslr/nerfstudio/", lambda path: (_dslr(Path(path)) / TRANSFORMS).is_file(), open_scannetpp
    ),
)  # fmt: skip
