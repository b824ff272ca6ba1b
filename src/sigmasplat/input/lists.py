"""Read text files of numbers, one entry per line, comments after #; every problem becomes a SourceError that names the
line."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.files.reading import read_text
from sigmasplat.input.pose_files import rigid_transform


def read_poses(path: Path) -> Trajectory:
    """Read "t tx ty tz qx qy qz qw" lines. Raises SourceError naming the line whose pose is not finite or not rigid."""
    times, poses = [], []
    for line, words in read_lines(path):
        if len(words) != 8:
            raise SourceError(f"{path}:{line}: expected 't tx ty tz qx qy qz qw', found {len(words)} values")
        t, *values = parse_numbers(path, line, words)
        times.append(t)
        x, y, z, qx, qy, qz, qw = values
        poses.append(rigid_transform(f"{path}:{line}", [x, y, z], [qw, qx, qy, qz]))
    if not poses:
        raise SourceError(f"{path}: holds no poses; delete it or add poses")
    return Trajectory(np.array(times), np.stack(poses))


def read_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number from 1, words) of every line that is not empty or a comment."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split("#")[0].replace(",", " ").split()
        if words:
            yield number, words


def parse_numbers(path: Path, line: int, words: list[str]) -> list[float]:
    """Read finite numbers. Raises SourceError naming file and line."""
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise SourceError(f"{path}:{line}: expected numbers, found {' '.join(words)!r}") from error
    if not np.isfinite(values).all():
        raise SourceError(f"{path}:{line}: not finite: {' '.join(words)!r}; delete the line")
    return values
