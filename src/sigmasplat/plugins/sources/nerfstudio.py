"""Read a folder of nerfstudio or instant-ngp (NeRFCapture) with depth, transforms.json, raw exports of Polycam and of
3d Scanner App, and Apple's ARKitScenes.

transforms.json        see `input/transforms.py`; depth_unit_scale_factor or integer_depth_scale is metres per unit,
                       default 0.001; timestamp in every frame, or times in the names, else 1/30 s apart
images/…  depths/…     file_path and depth_file_path or depth_path, relative to the folder, ordered by time or number;
                       if no frame names its depth, the image of its name in depth/ or depths/

keyframes/cameras/TIME.json  images/TIME.jpg  depth/TIME.png     Polycam: time in µs, fx fy cx cy width height, t_00 …
                       t_23 (camera to world, ARKit's axes), depth in mm; corrected_cameras/ and corrected_images/, if
                       they exist, have better poses and no lens distortion (layout: PolyCam/polyform)
keyframes/confidence/TIME.png          0, 54 or 255: readings with 0 are ignored

frame_00000.json  frame_00000.jpg      3d Scanner App, "All Data": cameraPoseARFrame (16 numbers by rows, camera to
depth_00000.png  conf_00000.png        world, ARKit's axes), intrinsics (9 numbers by rows), time in s; depth in mm,
                                       confidence 0 to 2; only some frames have a colour image

lowres_wide/VIDEO_TIME.png             ARKitScenes, raw, 3dod or upsampling: also wide/ or vga_wide/; the same times in
lowres_depth/ (mm) and confidence/     the names
lowres_wide_intrinsics/*.pincam        width height fx fy cx cy; times may differ by 1 ms
lowres_wide.traj                       time, rotation vector, translation in m; world to camera, ten per second

If depth has another size than colour (as on phones), both are assumed to share one camera.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sigmasplat.api as api
from sigmasplat.api import Fields, InputConfig, RecordedSource, SourceError, SourceFormat, se3

NAME = "transforms.json"
UNIT_KEYS = ("depth_unit_scale_factor", "integer_depth_scale")
DEPTH, METRES_PER_UNIT = "depth_file_path", 0.001
"""nerfstudio's default of depth_unit_scale_factor."""


def open_nerfstudio(place: str, settings: InputConfig) -> RecordedSource:
    """Open a folder with depth. Raises SourceError if its JSON file, images or camera cannot be used."""
    path = Path(place) / NAME
    return _open(path.parent, path, api.read_json_object(path), settings)


def _open(
    folder: Path, path: Path, fields: Fields, settings: InputConfig, by: str = NAME, truth: api.Trajectory | None = None
) -> RecordedSource:
    named = sorted(api.read_frames(path, fields), key=lambda frame: api.natural_key(frame["file_path"]))
    named = [frame | {DEPTH: frame.get(DEPTH, frame.get("depth_path"))} for frame in named]
    if by_name := not any(frame[DEPTH] for frame in named):
        depths = api.list_images(api.image_folder(folder, api.DEPTH_FOLDERS), api.DEPTH_ENDINGS)
        beside = {depth.stem: str(depth.relative_to(folder)) for depth in depths}
        named = [frame | {DEPTH: beside.get(Path(frame["file_path"]).stem)} for frame in named]
    frames = [frame for frame in named if isinstance(frame[DEPTH], str)]
    if not frames:
        raise SourceError(
            f'{path}: no frame has a "depth_file_path" or "depth_path" (found {", ".join(fields["frames"][0])}); '
            "export depth with the images, see docs/data.md#without-depth"
        )
    skipped = [f"{path}: {frame['file_path']} has no {DEPTH}" for frame in named if not isinstance(frame[DEPTH], str)]
    files, read = [_files(folder, frame) for frame in frames], api.Origin("", f"read from {path}")
    times_s, times = api.times_of_names([color for color, _ in files])
    found = [frame.get("timestamp") for frame in frames]
    stamps = np.array([stamp if isinstance(stamp, int | float) else np.nan for stamp in found])
    if (stamps_s := api.seconds_of(stamps, bool((stamps % 1).any()))) is not None:
        times_s, times = stamps_s, read._replace(value="timestamp of each frame")
    order = np.argsort(times_s)
    frames, files, times_s = [frames[i] for i in order], [files[i] for i in order], times_s[order]
    sure = [api.listed_file(folder, name) if isinstance(name := f.get("confidence"), str) else None for f in frames]
    images = [api.ImagePair(float(t), *pair, confidence=c) for t, pair, c in zip(times_s, files, sure, strict=True)]
    key = next((key for key in UNIT_KEYS if key in fields), "")
    units = round(1.0 / api.positive_number(path, fields, key, METRES_PER_UNIT), 6)
    known = api.read_transforms_camera(path, fields, frames, api.first_size([i.color for i in images]), units)
    unit = {"depth unit": read if key else api.DEFINED} if key or by != NAME else {}
    known = replace(known, origins={**known.origins, **unit})
    truth = truth or api.build_trajectory(zip(times_s, (api.read_pose(path, frame) for frame in frames), strict=True))
    return api.folder_source(
        folder, settings, images, known, units, truth, skipped, one_camera=True, estimated=by,
        origins={"times": times, "pairs": read._replace(value="by name" if by_name else "named in each frame")}, 
    )  # fmt: skip


def _files(folder: Path, frame: Fields) -> tuple[Path, Path]:
    """Return the colour and the depth file of a frame; instant-ngp omits the file ending of colour."""
    color, depth = (api.listed_file(folder, frame[key]) for key in ("file_path", DEPTH))
    bare = not color.suffix and not color.is_file()
    return (color.with_suffix(".png") if bare else color), depth


def open_polycam(place: str, settings: InputConfig) -> RecordedSource:
    """Open the folder keyframes of a raw export. Raises SourceError as `open_nerfstudio`."""
    folder = Path(place)
    kind = "corrected_" if all((folder / f"corrected_{part}").is_dir() for part in ("cameras", "images")) else ""
    frames = []
    for path in api.list_images(folder / f"{kind}cameras", (".json",)):
        number = partial(api.json_number, path, api.read_json_object(path))
        frame: Fields = {"file_path": f"{kind}images/{path.stem}.jpg", DEPTH: f"depth/{path.stem}.png"}
        frame |= {"confidence": f"confidence/{path.stem}.png"}
        frame |= {"fl_x": number("fx"), "fl_y": number("fy"), "w": number("width"), "h": number("height")}
        frame |= {key: number(key) + 0.5 for key in ("cx", "cy")}  # ARKit measures from the centre of the first pixel
        frame |= {"transform_matrix": [number(f"t_{i // 4}{i % 4}") for i in range(12)]}
        frames.append(frame | ({"timestamp": int(path.stem) * 1e-6} if path.stem.isdecimal() else {}))
    source = _open(folder, folder / f"{kind}cameras", {"frames": frames}, settings, "ARKit")
    done, all_images = {Path(frame["file_path"]).stem for frame in frames}, (folder / "images").glob("*.jpg")
    source.skipped += [f"{path}: not in {kind}cameras" for path in sorted(all_images) if path.stem not in done]
    return source


def open_3d_scanner_app(place: str, settings: InputConfig) -> RecordedSource:
    """Open a folder of the export "All Data". Raises SourceError as `open_nerfstudio`."""
    folder, frames = Path(place), list[Fields]()
    for path in sorted(folder.glob("frame_*.json")):
        if path.with_suffix(".jpg").is_file():
            fields, number = api.read_json_object(path), path.stem.removeprefix("frame_")
            flat = fields.get("intrinsics")
            K = {f"intrinsics, number {i}": n for i, n in enumerate(flat)} if isinstance(flat, list) else {}
            fx, cx, fy, cy = (api.json_number(path, K, f"intrinsics, number {i}") for i in (0, 2, 4, 5))
            frame: Fields = {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "timestamp": fields.get("time")}
            frame |= {"file_path": f"{path.stem}.jpg", DEPTH: f"depth_{number}.png", "confidence": f"conf_{number}.png"}
            frames.append(frame | {"transform_matrix": fields.get("cameraPoseARFrame")})
    return _open(folder, folder / "frame_*.json", {"frames": frames}, settings, "ARKit")


def open_arkitscenes(place: str, settings: InputConfig) -> RecordedSource:
    """Open the folder of a video. Raises SourceError as `open_nerfstudio`."""
    folder, frames = Path(place), list[Fields]()
    names = api.first_subfolder(folder, WIDE) or folder / WIDE[0]
    cameras = folder / f"{names.name}_intrinsics"
    colors, depths = (api.list_images(place, (".png",)) for place in (names, folder / "lowres_depth"))
    if not colors or not depths or not (pincams := api.list_images(cameras, (".pincam",))):
        raise SourceError(
            f"{folder}: no .png in {names.name} and depth, or no .pincam in {cameras.name}; download both"
        )
    times_s, depth_s, camera_s = (api.times_of_names(paths)[0] for paths in (colors, depths, pincams))
    near = {i: depths[j].name for i, j in api.associate(times_s, depth_s, settings.max_gap_s).tolist()}
    nearest = np.searchsorted((camera_s[1:] + camera_s[:-1]) / 2, times_s)
    for i, (color, j) in enumerate(zip(colors, nearest, strict=True)):
        numbers, depth = _rows(pincams[j], 6)[0] - [0, 0, 0, 0, -0.5, -0.5], near.get(i)
        frame: Fields = dict(zip(("w", "h", "fl_x", "fl_y", "cx", "cy"), numbers.tolist(), strict=True))
        frame |= {DEPTH: depth and f"lowres_depth/{depth}", "confidence": f"confidence/{depth}"}
        frames.append(frame | {"file_path": f"{names.name}/{color.name}"})
    path = folder / "lowres_wide.traj"
    rows = _rows(path, 7) if path.is_file() else np.zeros((0, 7))
    T_camera_world = se3.exp_stack(np.pad(rows[:, 1:4], ((0, 0), (3, 0))))
    T_camera_world[:, :3, 3] = rows[:, 4:]
    poses = [api.checked_pose(str(path), T) for T in se3.inverse(T_camera_world)]
    truth = api.build_trajectory(zip(rows[:, 0], poses, strict=True))
    return _open(folder, cameras, {"frames": frames}, settings, "ARKit", truth)


def _rows(path: Path, count: int) -> NDArray[np.float64]:
    """Read lines of so many numbers [N, count]. Raises SourceError naming the file if there is none, or another."""
    rows = [api.parse_numbers(path, line, words) for line, words in api.read_lines(path)]
    if (found := {len(row) for row in rows}) != {count}:
        raise SourceError(f"{path}: expected lines of {count} numbers, found {sorted(found)}; download it again")
    return np.array(rows)


WIDE = ("lowres_wide", "wide", "vga_wide")

PLUGIN = (
    SourceFormat("nerfstudio", NAME, lambda path: (Path(path) / NAME).is_file(), open_nerfstudio),
    SourceFormat(
        "Polycam", "keyframes/ with images/, depth/ and cameras/*.json",
        lambda path: Path(path, "depth").is_dir() and any(Path(path, "cameras").glob("*.json")),
        open_polycam, sensor="lidar-iphone",
    ),
    SourceFormat(
        "3d Scanner App", "frame_00000.json, frame_00000.jpg and depth_00000.png",
        lambda path: any(Path(path).glob("frame_*.json")) and any(Path(path).glob("depth_*.png")),
        open_3d_scanner_app, sensor="lidar-iphone",
    ),
    SourceFormat(
        "ARKitScenes", "lowres_wide/ and lowres_depth/",
        lambda path: bool(api.first_subfolder(Path(path), WIDE)) and Path(path, "lowres_depth").is_dir(),
        open_arkitscenes, sensor="lidar-iphone",
    ),
)  # fmt: skip
