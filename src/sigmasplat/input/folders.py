"""Find the image files of a recording and pair colour with depth."""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

from sigmasplat.errors import SourceError

FRAMES_PER_SECOND = 30.0
"""Frame rate of recordings without timestamps, by convention."""

COLOR_FOLDERS = ("color", "colour", "rgb", "image", "images")
DEPTH_FOLDERS = ("depth", "depths")
COLOR_ENDINGS = (".jpg", ".jpeg", ".png", ".bmp", ".ppm", ".tif", ".tiff", ".webp")
DEPTH_ENDINGS = (".png", ".pgm", ".tif", ".tiff", ".npy")

Key = TypeVar("Key", int, str)


def first_subfolder(folder: Path, names: Iterable[str]) -> Path | None:
    """Return the first of the named subfolders that exists, None if none does."""
    return next((folder / name for name in names if (folder / name).is_dir()), None)


def list_images(folder: Path | None, endings: Sequence[str]) -> list[Path]:
    """Return the images of a folder in the order of the numbers in their names: 2.png before 10.png."""
    if folder is None or not folder.is_dir():
        return []
    found = (path for path in folder.iterdir() if path.suffix.lower() in endings and not path.name.startswith("."))
    return sorted(found, key=natural_key)


def natural_key(path: Path | str) -> list[tuple[int, str]]:
    """Return a sort key that compares digits in a name as numbers and the rest as text."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", str(path)) if part]


def times_of_names(paths: Sequence[Path]) -> list[float]:
    """Return the times in the names if all have a decimal point and increase; else frames are 1/30 s apart."""
    try:
        times = [float(path.stem) for path in paths]
    except ValueError:
        times = []
    rising = all(a < b for a, b in pairwise(times))
    if times and rising and all("." in path.stem for path in paths):
        return times
    return [i / FRAMES_PER_SECOND for i in range(len(paths))]


def index_by_number(paths: Iterable[Path]) -> dict[int, Path]:
    """Map the last number in each file name to its path, ascending; names without a number are left out."""
    numbers = ((re.findall(r"[0-9]+", path.stem), path) for path in paths)
    return dict(sorted((int(found[-1]), path) for found, path in numbers if found))


def pair_images(
    folder: Path, colors: Mapping[Key, Path], depths: Mapping[Key, Path], color_name: str, depth_name: str
) -> tuple[list[Key], list[str]]:
    """Return the keys that colour and depth share, in the order of colour, and why the other images are left out.

    color_name, depth_name: file patterns for messages. Raises SourceError if one kind is missing or no key is shared.
    """
    if not depths:
        raise SourceError(
            f"no depth images in {folder} (looked for {depth_name}); is this the RGB-only download? "
            "see docs/data.md#without-depth"
        )
    if not colors:
        raise SourceError(f"no colour images in {folder} (looked for {color_name}); is the download complete?")
    keys = [key for key in colors if key in depths]
    if not keys:
        first = f"{next(iter(colors.values())).name} and {next(iter(depths.values())).name}"
        raise SourceError(
            f"{folder}: {color_name} and {depth_name} have no number in common (found {first}); "
            "are both from one recording?"
        )
    return keys, [f"{colors[key]}: no {depth_name} with its number" for key in colors if key not in depths]


FrameFiles = dict[str, dict[int, Path]]

_NAME = re.compile(r"frame-([0-9]+)\.(?:(color)\.(?:png|jpe?g)|(depth)\.(?:png|pgm|tiff?)|(pose)\.txt)")


def frame_files(folder: Path) -> FrameFiles:
    """Map "color", "depth" and "pose" to the frame-N files of each kind by number, ascending."""
    found: FrameFiles = {"color": {}, "depth": {}, "pose": {}}
    for path in sorted(folder.glob("frame-*")):
        match = _NAME.fullmatch(path.name.lower())
        if match:
            kind = next(group for group in match.groups()[1:] if group)
            found[kind][int(match.group(1))] = path
    return found


def has_frame_files(folder: Path) -> bool:
    """Return whether there is at least one frame-N file."""
    return any(_NAME.fullmatch(path.name.lower()) for path in folder.glob("frame-*"))
