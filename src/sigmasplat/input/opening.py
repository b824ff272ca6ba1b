"""Open a sequence of any known format: ask each format whether it recognises the path. Recordings that hold images but
no depth (video, photos, stereo pairs) are recognised too."""

import importlib
import os
import sqlite3
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import fields, replace
from itertools import islice
from pathlib import Path
from typing import Any, cast

from sigmasplat.config import InputConfig
from sigmasplat.data.camera_errors import CameraErrors
from sigmasplat.errors import ConfigError, SourceError, nearest
from sigmasplat.files.pictures import open_image
from sigmasplat.files.reading import guarded, open_regular
from sigmasplat.input.calibration import Origin
from sigmasplat.input.given import Corrected, Masked, Posed
from sigmasplat.input.images import COLOR_ENDINGS, VIDEO_ENDINGS
from sigmasplat.input.source import Source, Subset
from sigmasplat.registry import SourceFormat, rows

PHOTO_ENDINGS = (*COLOR_ENDINGS, ".heic", ".dng")
RGBD_ENDINGS = (".exr", ".npy", ".pgm", ".bag", ".mcap", ".db3", ".r3d", ".sens", ".oni", ".klg", ".svo", ".mkv")
"""Files that may hold depth; .mkv is what Azure Kinect records."""
MAX_LEVELS, MAX_ENTRIES = 4, 20_000
"""How far a folder is searched: EuRoC's images are three levels down, in mav0/cam0/data."""


def without_depth(path: Path) -> SourceError | None:
    """Return the error for a path that holds images but no depth; None if it may hold depth, or holds no image."""
    found = _described(path)
    if found is None:
        return None
    return SourceError(
        f"{path} holds images but no depth ({found}); SigmaSplat needs RGB-D, a depth image for every colour image: "
        "see docs/data.md#without-depth"
    )


def _described(path: Path) -> str | None:
    """Describe the images at the path in a few words; None if it may hold depth or holds no image."""
    if not path.is_dir():
        ending = path.suffix.lower()
        return "a video" if ending in VIDEO_ENDINGS else "a single image" if _is_color_image(path) else None
    files = list(islice(_files(path), MAX_ENTRIES))
    if any("depth" in str(file.relative_to(path)).lower() or file.suffix.lower() in RGBD_ENDINGS for file in files):
        return None
    folders: dict[Path, Path] = {}  # with one of their images
    for file in files:
        if file.suffix.lower() in PHOTO_ENDINGS:
            folders.setdefault(file.parent, file)
    if not all(map(_is_color_image, folders.values())):
        return None
    if folders:
        return "images in " + ", ".join(sorted(str(folder.relative_to(path)) for folder in folders)[:4])
    return next((f"video: {file.name}" for file in files if file.suffix.lower() in VIDEO_ENDINGS), None)


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder, at most MAX_LEVELS deep, hidden ones left out."""
    for parent, folders, names in os.walk(folder):
        depth = len(Path(parent).relative_to(folder).parts)
        folders[:] = sorted(name for name in folders if not name.startswith(".")) if depth + 1 < MAX_LEVELS else []
        yield from (Path(parent) / name for name in sorted(names) if not name.startswith("."))


def _is_color_image(path: Path) -> bool:
    """Return whether a file is named as an image and does not hold 16-bit or float values, as depth images do."""
    if path.suffix.lower() not in PHOTO_ENDINGS:
        return False
    try:
        with open_image(path) as image:
            return not image.mode.startswith(("I", "F"))
    except SourceError:
        return True  # .heic, .dng, or damaged: then its name decides


REMEDIES = {
    ".zip .tar .tgz .gz .bz2 .xz .zst .7z .rar": "an archive; unpack it first",
    ".mkv": "a recording of Azure Kinect; extract it with Open3D's azure_kinect_mkv_reader.py",
    ".svo .svo2": "a recording of a ZED; export it with ZED_SVO_Export, mode 4 (left images and 16-bit depth)",
    ".oni .klg": "a recording of OpenNI; export it as images of colour and 16-bit PNG of depth",
}
"""What files of other programs are, by their endings, and how they can be read."""
PACKED = (".bag", ".mcap", ".db3", ".r3d")
"""Endings of files that may each be a whole sequence. A folder of such files is refused with their names."""


def formats() -> tuple[SourceFormat, ...]:
    """Return the formats of all plug-ins, by priority and name."""
    return tuple(sorted(rows(SourceFormat), key=lambda known: -known.priority))


def open_source(path: str | Path, settings: InputConfig | None = None, **changes: Any) -> Source:
    """Open a recorded or synthetic sequence; the format is recognised from the content of `path`.

    `path` is a folder or file, or "synthetic" with options as in "synthetic:frames=200,seed=1,noise=1". `settings`
    choose which frames are read and how they are processed; each can also be given by name: stride=2, limit=100.
    Raises SourceError if the path does not exist, no format recognises it, or its content cannot be used;
    ConfigError on an unknown setting.
    """
    known = [field.name for field in fields(InputConfig)]
    for name in changes:
        if name not in known:
            raise ConfigError(f"unknown setting input.{name}{nearest(name, known)}; there are {', '.join(known)}")
    chosen = replace(settings or InputConfig(width=0), **changes)
    with _guarded(path):
        source = _whole(path, chosen)
        errors = CameraErrors.given(chosen.calibrate)
        source = Corrected(source, errors) if any(errors.values) else source
        source = Masked(source, Path(chosen.masks)) if chosen.masks else source
        scales = chosen.poses_scale or 1.0, chosen.predicted_scale or 1.0
        source = Posed(source, chosen.poses, *scales) if chosen.poses else source
    part = chosen.stride > 1 or chosen.limit or chosen.start_s or chosen.end_s
    return Subset(source, chosen) if part and not source.live else source


def _whole(path: str | Path, settings: InputConfig) -> Source:
    """Open a whole sequence: with its own depth, or with predicted depth instead, also where it has none."""
    predicted: Any = None
    if settings.predicted_depth:
        predicted = importlib.import_module("sigmasplat.plugins.predicted_depth.source")
        if predicted.lacks_depth(Path(path), _sure_format(path) is not None):
            return cast(Source, predicted.open_color_only(Path(path), settings))
    known, place = _found(path)
    source = known.open(str(place), settings)
    source.sensor = source.sensor or known.sensor
    if place != path:
        source.origins["recording"] = Origin(str(place), f"the only one in {path}")
    return cast(Source, predicted.WithPredictedDepth(source, settings)) if predicted else source


def format_name(path: str | Path, settings: InputConfig) -> str:
    """Return the name of the format that `open_source` reads. Raises SourceError if none recognises the path."""
    if not settings.predicted_depth:
        return format_of(path).name
    known = _sure_format(path)
    return f"{known.name if known else 'colour only'}, with predicted depth"


def format_of(path: str | Path) -> SourceFormat:
    """Return the first format that recognises the path. Raises SourceError if none does."""
    return _found(path)[0]


def _found(path: str | Path) -> tuple[SourceFormat, str | Path]:
    """Return the format and the path of a recording, or of the only recording in a folder that is none itself."""
    with _guarded(path):
        if known := _matching_format(path):
            return known, path
        entries = [entry for entry in Path(path).iterdir() if entry.is_dir()] if Path(path).is_dir() else []
        inner = [(known, entry) for entry in entries if (known := _matching_format(entry))]
        if len(inner) != 1:
            raise _unknown_format(Path(path))
        return inner[0]


def _guarded(path: str | Path) -> AbstractContextManager[None]:
    """Turn what the readers of formats do not catch themselves into SourceError."""
    return guarded(path, "check its files and permissions, or copy it again", SourceError, "cannot be used")


def _matching_format(path: str | Path) -> SourceFormat | None:
    return next((known for known in formats() if known.recognises(str(path))), None)


def _sure_format(path: str | Path) -> SourceFormat | None:
    """Return the format that recognises the path, None if it only guesses, or there is none."""
    with _guarded(path):
        known = _matching_format(path)
    return known if known is not None and known.priority >= 0 else None


def sqlite_tables(path: Path) -> set[str]:
    """Return the names of the tables of an SQLite file; empty if it is damaged or another file."""
    with open_regular(path) as file:
        found = file.read(15) == b"SQLite format 3"
    place = f"{path.resolve().as_uri()}?mode=ro&immutable=1" if found else ":memory:"
    with suppress(sqlite3.Error), closing(sqlite3.connect(place, uri=True)) as database:
        return {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    return set()


def _unknown_format(path: Path) -> SourceError:
    """Return the error for a path that no format recognises: missing, of several sequences, without depth, unknown."""
    if not path.exists():  # a loop of links, or a name that is too long, was refused before
        return SourceError(
            f"no such folder or file: {path}; give a recording, or 'synthetic' for the built-in room, "
            "or 'realsense' for the camera"
        )
    entries = sorted(path.iterdir()) if path.is_dir() else []
    candidates = (entry for entry in entries if entry.is_dir() or entry.suffix in PACKED)
    inner = [(entry.name, known) for entry in candidates if (known := _matching_format(entry))]
    if inner:
        names = ", ".join(f"{name} ({known.name}: {known.looked_for})" for name, known in inner[:4])
        names += ", …" * (len(inner) > 4)
        return SourceError(
            f"{path} holds sequences: {names}; give the path of one of them, for example {path / inner[0][0]}"
        )
    for file in sorted(path.glob("*.db")) if path.is_dir() else [path]:
        if tables := sqlite_tables(file):
            what = f"an SQLite file, but not a ROS 2 bag (tables {', '.join(sorted(tables)[:8])}); export its images"
            if {"Node", "Data"} <= tables:
                what = f"a database of RTAB-Map; export its images with: rtabmap-export --images {file}"
            return SourceError(f"{file} is {what}, then name their folders rgb and depth, and give what holds both")
    if problem := without_depth(path):
        return problem
    for file in sorted(path.glob("*.*")) if path.is_dir() else [path]:
        if remedy := next((r for endings, r in REMEDIES.items() if file.suffix.lower() in endings.split()), None):
            return SourceError(f"{file} is {remedy}, and give the folder of the images")
    known_names = ", ".join(known.name for known in formats())
    if not path.is_dir():
        return SourceError(
            f"{path} is a file of unknown format; give the folder of the sequence (known formats: {known_names})"
        )
    found = [entry.name + "/" * entry.is_dir() for entry in entries]
    listing = ", ".join(found[:8]) + (f", … {len(found)} entries" if len(found) > 8 else "") or "an empty folder"
    return SourceError(
        f"unknown format: {path} (found {listing}; known formats: {known_names}); docs/data.md shows the layouts"
    )
