"""Read the text files of a TUM folder: what lies at which time, and where the camera truly was."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import SourceError
from sigmasplat.model import se3
from sigmasplat.model.trajectory import Trajectory


def read_list(path: Path) -> tuple[NDArray[np.float64], list[Path]]:
    """Read "t path" lines: timestamps [N] seconds and image paths. Raises SourceError naming file and line."""
    times, paths = [], []
    for line, words in lines(path):
        if len(words) < 2:
            raise SourceError(f"{path}:{line}: 'timestamp path' wanted, found {' '.join(words)!r}")
        times.append(numbers(path, line, words[:1])[0])
        paths.append(path.parent / " ".join(words[1:]))
    if not paths:
        raise SourceError(f"{path}: lists no images")
    return np.array(times), paths


def read_poses(path: Path) -> Trajectory:
    """Read "t tx ty tz qx qy qz qw" lines. Raises SourceError naming the line whose pose is not finite or not rigid."""
    times, poses = [], []
    for line, words in lines(path):
        if len(words) != 8:
            raise SourceError(f"{path}:{line}: 't tx ty tz qx qy qz qw' wanted, found {len(words)} values")
        t, *translation_quaternion = numbers(path, line, words)
        times.append(t)
        poses.append(_pose(path, line, np.array(translation_quaternion)))
    if not poses:
        raise SourceError(f"{path}: holds no poses; fill it or delete it")
    return Trajectory(np.array(times), np.stack(poses))


def lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number from 1, words) of every line that says something."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: not readable as text ({error})") from error
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].replace(",", " ").split()
        if words:
            yield number, words


def numbers(path: Path, line: int, words: list[str]) -> list[float]:
    """Read finite numbers. Raises SourceError naming file and line."""
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise SourceError(f"{path}:{line}: numbers wanted, found {' '.join(words)!r}") from error
    if not np.isfinite(values).all():
        raise SourceError(f"{path}:{line}: not finite: {' '.join(words)!r}; drop the line")
    return values


def _pose(path: Path, line: int, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Build T_world_camera from tx ty tz qx qy qz qw; only a unit quaternion is a rotation."""
    norm = float(np.linalg.norm(values[3:]))
    if abs(norm - 1.0) > 1e-2:
        raise SourceError(f"{path}:{line}: the pose is not rigid: its quaternion has length {norm:.4g}, not 1")
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_quaternion(values[[6, 3, 4, 5]])
    T[:3, 3] = values[:3]
    return T
