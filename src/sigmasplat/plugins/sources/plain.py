"""Read plain folders of colour and depth images, and those of Open3D's reconstruction system and of Redwood.

color|colour|rgb|image|images/   depth|depths/     paired by the time in the name, or name, number, order; also with
                                                   other words (image_left/), and in one folder (0-color.png)
calibration.json                                   fx fy cx cy [width height depth_scale …], or --fx on the command line
groundtruth.txt                                    optional: "t tx ty tz qx qy qz qw", t as for the images

Names such as 12.033333.png or 1612345678033333333.png are times; otherwise frames are 1/30 s apart. Depth is in mm by
default. This format is tried last. Open3D and Redwood, recognised by these files:

color|rgb|image/000000.jpg  depth/000000.png              paired by the number in the name
rgb/0000001-000000033000.jpg  depth/0000001-0000….png     Redwood: number and time in µs; paired by time
intrinsic.json | camera_intrinsic.json                    width, height, intrinsic_matrix (9 numbers by columns);
                                                          and depth_scale, fps if written by Open3D's recorders
trajectory.log | NAME.log                                 per pose three numbers and 4 matrix rows, camera to world

Without an intrinsic file, PrimeSense's factory values are used (Redwood's camera); depth in mm.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sigmasplat.api as api
from sigmasplat.api import ImagePair, InputConfig, Origin, RecordedSource, SourceError, SourceFormat

NAMES = "color|rgb|images/*", "depth/*"
REMEDY = "write rgb.txt and depth.txt with 'time path' lines, or give each pair the same name"


def open_plain(path: str, settings: InputConfig) -> RecordedSource:
    """Open a folder. Raises SourceError if images cannot be paired or the camera is unknown."""
    folder = Path(path)
    colors, depths = _images(folder)
    if not depths and not api.image_folder(folder, KINDS[1]) and (problem := api.without_depth(folder)):
        raise problem
    images, skipped, origins = _pairs(folder, colors, depths, settings)
    truth = api.read_groundtruth(folder)
    return api.folder_source(folder, settings, images, None, api.MM_PER_METRE, truth, skipped, origins=origins)


KINDS = api.COLOR_FOLDERS, api.DEPTH_FOLDERS


def _images(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the images of colour and of depth: of their folders, else of the folder itself by the words of names."""
    color, depth = (api.image_folder(folder, names) for names in KINDS)
    if color or depth:
        return api.list_images(color, api.COLOR_ENDINGS), api.list_images(depth, api.DEPTH_ENDINGS)
    images = [path for path in api.list_images(folder, api.COLOR_ENDINGS + api.DEPTH_ENDINGS) if path.parent == folder]
    depths = api.named_as(images, api.DEPTH_FOLDERS)
    return api.named_as(images, (*api.COLOR_FOLDERS, "left")) or [p for p in images if p not in depths], depths


Found = tuple[list[ImagePair], list[str], dict[str, Origin]]
"""Pairs of images, why others are left out, and the origins of times and pairs."""


def _pairs(folder: Path, colors: list[Path], depths: list[Path], settings: InputConfig) -> Found:
    """Pair images by the times in their names, else by name, by number, or by order if names do no more than count."""
    (color_s, read), (depth_s, depth_read) = api.times_of_names(colors), api.times_of_names(depths)
    timed = [read.origin, depth_read.origin].count(api.NAMED)
    if timed == 2:
        return _timed_pairs(folder, colors, depths, settings, color_s, depth_s)
    found, skipped, how = list(zip(colors, depths, strict=False)), list[str](), Origin("by order", api.ASSUMED, REMEDY)
    by_name = [{path.stem: path for path in paths} for paths in (colors, depths)]
    by_number = [{str(n): path for n, path in api.index_by_number(paths).items()} for paths in (colors, depths)]
    for way, (color_of, depth_of) in {"by name": by_name, "by number": by_number}.items():
        unique = way == "by name" or (len(color_of) + len(depth_of) == len(colors) + len(depths) and not timed)
        if not colors or not depths or (unique and color_of.keys() & depth_of.keys()):
            keys, skipped = api.pair_images(folder, color_of, depth_of, *NAMES)
            found, how = [(color_of[key], depth_of[key]) for key in keys], Origin(way, api.NAMED)
            break
    else:
        steps = [set(np.diff([*api.index_by_number(paths)]).tolist()) for paths in (colors, depths)]
        if len(colors) != len(depths) or max(map(len, steps)) > 1 or timed:
            raise SourceError(
                f"{folder}: {len(colors)} colour and {len(depths)} depth images have no name, time or number in common "
                f"(found {colors[0].name} and {depths[0].name}); {REMEDY}"
            )
    times_s, times = api.times_of_names([color for color, _ in found])
    images = [ImagePair(t, *pair) for t, pair in zip(times_s.tolist(), found, strict=True)]
    return images, skipped, {"times": times, "pairs": how}


def _timed_pairs(
    folder: Path, colors: list[Path], depths: list[Path], settings: InputConfig,
    color_s: NDArray[np.float64], depth_s: NDArray[np.float64],
) -> Found:  # fmt: skip
    depth_s = depth_s - settings.depth_delay_s
    pairs, alone = api.pair_times(folder, {"colour": color_s, "depth": depth_s}, settings)
    late_s = {(i, j): float(depth_s[j] - color_s[i]) for i, j in pairs}
    images = [ImagePair(float(color_s[i]), colors[i], depths[j], depth_late_s=s) for (i, j), s in late_s.items()]
    times = Origin(f"{color_s.min():.3f} … {color_s.max():.3f} s", api.NAMED)
    origins = {"times": times} | api.time_origins(settings, "by time", api.NAMED)
    return images, [f"{colors[i]}: no depth within {settings.max_gap_s:g} s" for i in alone], origins


INTRINSIC_NAMES = ("intrinsic.json", "intrinsics.json", "camera_intrinsic.json", "camera_intrinsics.json")
PRIMESENSE = api.published(
    "PrimeSense's factory values", api.Camera(640, 480, 525.0, 525.0, 319.5, 239.5), api.MM_PER_METRE
)
"""Open3D's PrimeSenseDefault."""

_TIMED = re.compile(r"([0-9]+)-([0-9]{9,})")


def open_redwood(path: str, settings: InputConfig) -> RecordedSource:
    """Open a folder. Raises SourceError if images, camera or trajectory cannot be used."""
    folder = Path(path)
    file = api.first_file(folder, INTRINSIC_NAMES)
    fields = api.read_json_object(file) if file else {}
    rate = api.positive_number(file or folder, fields, "fps", api.FRAMES_PER_SECOND)
    colors = api.list_images(api.first_subfolder(folder, api.COLOR_FOLDERS), api.COLOR_ENDINGS)
    depths = api.list_images(folder / "depth", api.DEPTH_ENDINGS)
    if colors and depths and all(_TIMED.fullmatch(path.stem) for path in colors + depths):
        stamps = [np.array([int(p.stem.split("-")[1]) * 1e-6 for p in paths]) for paths in (colors, depths)]
        images, skipped, origins = _timed_pairs(folder, colors, depths, settings, *stamps)
        images = [replace(i, timestamp_s=i.timestamp_s + i.depth_late_s) for i in images]  # poses are those of depth
    elif api.NAMED in (api.times_of_names(colors)[1].origin, api.times_of_names(depths)[1].origin):
        images, skipped, origins = _pairs(folder, colors, depths, settings)
    else:
        names = f"{'|'.join(api.COLOR_FOLDERS)}/*.jpg", "depth/*.png"
        numbered, skipped = api.numbered_pairs(
            folder, api.index_by_number(colors), api.index_by_number(depths), *names, rate
        )
        times = Origin(f"{rate:g} per second", f"read from {file}") if "fps" in fields else api.ASSUMED_TIMES
        images, origins = [*numbered.values()], {"times": times, "pairs": Origin("by number", api.NAMED)}
    size = api.first_size([image.color for image in images])
    known = api.read_intrinsics(file, size, api.MM_PER_METRE) if file else PRIMESENSE
    if known is None:
        raise SourceError(f'{file}: field "intrinsic_matrix" is not 9 numbers by columns; correct it')
    known = known if file else api.intrinsics_beside(folder, settings, size, api.MM_PER_METRE) or known
    truth = _truth(folder, images)
    return api.folder_source(
        folder, settings, images, known, known.depth_units_per_metre, truth, skipped, origins=origins
    )


def _truth(folder: Path, images: list[ImagePair]) -> api.Trajectory | None:
    """Read the log; the first number of a pose is the index of its depth image, from 0."""
    path = _log_in(folder)
    if path is None:
        return None
    rows = [(line, api.parse_numbers(path, line, words)) for line, words in api.read_lines(path)]
    if len(rows) % 5 or any(len(row) != (3 if i % 5 == 0 else 4) for i, (_, row) in enumerate(rows)):
        raise SourceError(f"{path}: each pose needs 5 lines: three numbers, then 4 rows of 4; is the file truncated?")
    depths = api.list_images(folder / "depth", api.DEPTH_ENDINGS)
    times = {image.depth: image.timestamp_s for image in images}
    timed = []
    for start in range(0, len(rows), 5):
        line, (index, *_) = rows[start]
        time = times.get(depths[int(index)]) if 0 <= index < len(depths) else None
        if time is not None:
            where = f"{path}:{line}"
            timed.append(
                (time, api.checked_pose(where, api.to_matrix(where, [row for _, row in rows[start + 1 : start + 5]])))
            )
    return api.build_trajectory(timed)


def _log_in(folder: Path) -> Path | None:
    """Return trajectory.log, else the only log that starts like a trajectory and is not odometry."""
    if (folder / "trajectory.log").is_file():
        return folder / "trajectory.log"
    logs = [path for path in folder.glob("*.log") if "odom" not in path.name and _begins_as_trajectory(path)]
    return logs[0] if len(logs) == 1 else None


def _begins_as_trajectory(path: Path) -> bool:
    if not path.is_file():
        return False
    with api.open_regular(path) as file:
        words = file.readline(200).decode("utf-8", "replace").split()
    return len(words) == 3 and all(word.isdecimal() for word in words)


def _is_redwood(path: str) -> bool:
    folder = Path(path)
    colors = api.first_subfolder(folder, api.COLOR_FOLDERS)
    if colors is None and not (folder / "depth").is_dir():
        return False
    timed = colors is not None and any(_TIMED.fullmatch(entry.stem) for entry in colors.iterdir())
    file = api.first_file(folder, INTRINSIC_NAMES)
    its_own = file is not None and b"intrinsic_matrix" in api.read_bytes(file, SourceError, api.MOST_JSON_BYTES)
    return timed or its_own or _log_in(folder) is not None


PLUGIN = (
    SourceFormat(
        "Redwood / Open3D", "color/, depth/ and camera_intrinsic.json or trajectory.log", _is_redwood, open_redwood,
        sensor="kinect-v1",
    ),
    SourceFormat(
        "plain folder", "color/ (or rgb/, images/) and depth/",
        lambda path: any(api.first_subfolder(Path(path), names) for names in KINDS) or all(_images(Path(path))),
        open_plain, priority=-1,
    ),
)  # fmt: skip
