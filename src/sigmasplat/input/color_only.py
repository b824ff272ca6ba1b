"""Recognise recordings that hold images but no depth: video, photos, stereo pairs."""

import os
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from sigmasplat.errors import SourceError
from sigmasplat.files.pictures import open_image
from sigmasplat.input.folders import COLOR_ENDINGS

VIDEO_ENDINGS = (".mp4", ".mov", ".m4v", ".avi", ".webm", ".3gp", ".mts")
PHOTO_ENDINGS = (*COLOR_ENDINGS, ".heic", ".dng")
RGBD_ENDINGS = (".exr", ".npy", ".pgm", ".bag", ".mcap", ".db3", ".r3d", ".sens", ".oni", ".klg", ".svo", ".mkv")
"""Files that may hold depth; .mkv is what Azure Kinect records."""
STEREO_FOLDER = re.compile(r"cam[0-9]|image_[0-9]+|(?:left|right).*")
"""Camera folders of EuRoC and TUM-VI, of KITTI, and of many stereo rigs."""
MAX_LEVELS, MAX_ENTRIES = 4, 20_000
"""How far a folder is searched: EuRoC's images are three levels down, in mav0/cam0/data."""


def without_depth(path: Path) -> SourceError | None:
    """Return the error for a path that holds images but no depth; None if it may hold depth, or holds no image."""
    found = _describe(path)
    if found is None:
        return None
    return SourceError(
        f"{path} holds images but no depth ({found}); SigmaSplat needs RGB-D, a depth image for every colour image: "
        "see docs/data.md#without-depth"
    )


def _describe(path: Path) -> str | None:
    """Describe the images at the path in a few words; None if it may hold depth or holds no image."""
    if not path.is_dir():
        ending = path.suffix.lower()
        return "a video" if ending in VIDEO_ENDINGS else "a single image" if _is_color_image(path) else None
    files = list(islice(_files(path), MAX_ENTRIES))
    if any("depth" in str(file.relative_to(path)).lower() or file.suffix.lower() in RGBD_ENDINGS for file in files):
        return None
    folders: dict[Path, list[Path]] = {}
    for file in files:
        if file.suffix.lower() in PHOTO_ENDINGS:
            folders.setdefault(file.parent, []).append(file)
    if not all(_is_color_image(images[0]) for images in folders.values()):
        return None
    videos = [file for file in files if file.suffix.lower() in VIDEO_ENDINGS]
    if stereo := _stereo_folders(folders):
        return f"stereo or multi-camera images in {', '.join(stereo[:4])}"
    if folders:
        folder = max(folders, key=lambda folder: len(folders[folder]))
        return "images" if folder == path else f"images in {folder.relative_to(path)}"
    return f"video: {videos[0].name}" if videos else None


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


def _stereo_folders(folders: dict[Path, list[Path]]) -> list[str]:
    """Return the folder names of a stereo rig's cameras; empty if there are fewer than two."""
    cameras = [folder.parent if folder.name == "data" else folder for folder in folders]
    names = sorted({camera.name for camera in cameras if STEREO_FOLDER.fullmatch(camera.name.lower())})
    return names if len(names) > 1 else []
