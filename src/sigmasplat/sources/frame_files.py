"""Find the files of recordings that keep all of a frame side by side: frame-000000.color.jpg, .depth.png, .pose.txt."""

import re
from pathlib import Path

Found = dict[str, dict[int, Path]]

_NAME = re.compile(r"frame-([0-9]+)\.(?:(color)\.(?:png|jpe?g)|(depth)\.(?:png|pgm|tiff?)|(pose)\.txt)")


def frame_files(folder: Path) -> Found:
    """Map "color", "depth" and "pose" to the files of each kind by number, ascending."""
    found: Found = {"color": {}, "depth": {}, "pose": {}}
    for path in sorted(folder.glob("frame-*")):
        match = _NAME.fullmatch(path.name.lower())
        if match:
            kind = next(group for group in match.groups()[1:] if group)
            found[kind][int(match.group(1))] = path
    return found


def has_frame_files(folder: Path) -> bool:
    """Tell whether there is at least one such colour or depth image."""
    return any(_NAME.fullmatch(path.name.lower()) for path in folder.glob("frame-*"))
