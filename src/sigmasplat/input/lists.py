"""Read text files of numbers and poses, and pair times; each problem becomes a SourceError that names file and line."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from sigmasplat.data import se3
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.files.reading import exists, read_text
from sigmasplat.types import Matrix

MOST_MATRIX_BYTES = 1 << 16

RIGID_TOLERANCE = 1e-2
"""Published poses are rounded; a matrix within this tolerance of a rotation is orthonormalised."""

QUATERNION_TOLERANCE = 1e-2
"""Largest deviation of a recorded quaternion's length from 1."""

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
"""Transforms camera axes with y down and z forward to axes with y up and z backward (OpenGL)."""


def read_matrix(path: Path) -> Matrix:
    """Read 3×4 or 4×4 numbers by rows as [4, 4]; they may be infinite. Raises SourceError naming the file."""
    text = read_text(path, most=MOST_MATRIX_BYTES)
    try:
        return to_matrix(str(path), [float(word) for word in text.replace(",", " ").split()])
    except ValueError as error:
        raise SourceError(f"{path}: not readable as a matrix of numbers ({error}); download it again") from error


def to_matrix(where: str, values: Any) -> Matrix:
    """Shape 12 or 16 numbers as [4, 4]. Raises SourceError naming `where` for any other count."""
    try:
        flat = np.array(values, np.float64).reshape(-1)
    except (ValueError, TypeError):
        flat = np.zeros(0)
    if len(flat) not in (12, 16):
        found = f"{len(values)} values" if isinstance(values, list) else repr(values)[:60]
        raise SourceError(f"{where}: expected a 4×4 matrix by rows, found {found}")
    return np.vstack([flat[:12].reshape(3, 4), flat[12:].reshape(-1, 4) if len(flat) == 16 else [[0, 0, 0, 1]]])


def checked_pose(where: str, T: Matrix) -> Matrix | None:
    """Return a camera-to-world pose, None if it is not finite, which marks a frame without a pose.

    Raises SourceError naming `where` if the matrix is finite but not rigid.
    """
    if not np.isfinite(T).all():
        return None
    if not se3.is_rigid(T, RIGID_TOLERANCE):
        numbers = " ".join(f"{value:.3g}" for value in T.reshape(-1)[:12])
        raise SourceError(f"{where}: not a rigid camera-to-world pose: {numbers}; delete it or correct its rotation")
    return T if se3.is_rigid(T) else se3.orthonormalise(T)


def rigid_transform(where: str, position: ArrayLike, quaternion_wxyz: ArrayLike) -> Matrix:
    """Build a transform [4, 4]. Raises SourceError naming `where` unless it is finite with a unit quaternion."""
    q, T = np.array(quaternion_wxyz, np.float64), np.eye(4)
    T[:3, 3] = position
    _refuse_unless_unit(where, float(np.linalg.norm(q)) if np.isfinite(T).all() else np.nan)
    T[:3, :3] = se3.rotation_from_quaternion(q)
    return T


def _refuse_unless_unit(where: str, length: float) -> None:
    if not abs(length - 1.0) < QUATERNION_TOLERANCE:
        raise SourceError(f"{where}: the pose is not rigid: its quaternion has length {length:.4g}, not 1")


def build_trajectory(timed: Iterable[tuple[float, Matrix | None]]) -> Trajectory | None:
    """Build the path of the frames (time in seconds, T_world_camera) that have a pose, None if no frame has one."""
    known = [(t, T) for t, T in timed if T is not None]
    return Trajectory(np.array([t for t, _ in known]), np.stack([T for _, T in known])) if known else None


def read_pose_files(timed: Iterable[tuple[float, Path]]) -> Trajectory | None:
    """Read one pose file per frame, given with its time; a missing file means an unknown pose."""
    return build_trajectory((t, checked_pose(str(path), read_matrix(path))) for t, path in timed if path.is_file())


def read_poses(path: Path, may_be_empty: bool = False) -> Trajectory:
    """Read TUM text, a pose "t tx ty tz qx qy qz qw" per line. Raises SourceError naming the line whose pose is not
    finite or not rigid, or if there is no pose, unless it `may_be_empty`."""
    lines, rows = list(read_lines(path)), list[list[float]]()
    for line, words in lines:
        if len(words) != 8:
            raise SourceError(f"{path}:{line}: expected 't tx ty tz qx qy qz qw', found {len(words)} values")
        rows.append(parse_numbers(path, line, words))
    if not rows and not may_be_empty:
        raise SourceError(f"{path}: holds no poses; delete it or add poses")
    table, T = np.array(rows, np.float64).reshape(-1, 8), np.tile(np.eye(4), (len(rows), 1, 1))
    for (line, _), length in zip(lines, np.linalg.norm(table[:, 4:], axis=1), strict=True):
        _refuse_unless_unit(f"{path}:{line}", length)
    T[:, :3, :3], T[:, :3, 3] = se3.rotation_from_quaternion(table[:, [7, 4, 5, 6]]), table[:, 1:4]
    return Trajectory(table[:, 0], T)


def read_groundtruth(folder: Path) -> Trajectory | None:
    """Read groundtruth.txt of a folder as `read_poses` does, None without one. Formats read it on opening: damage must
    stop the run before it starts, not its evaluation an hour later."""
    path = folder / "groundtruth.txt"
    return read_poses(path) if exists(path) else None


def read_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number from 1, words) of every line that is not empty or a comment."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split("#")[0].replace(",", " ").split()
        if words:
            yield number, words


def parse_any_numbers(path: Path, line: int, words: list[str]) -> list[float]:
    """Read numbers, which may be infinite or nan. Raises SourceError naming file and line."""
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise SourceError(f"{path}:{line}: expected numbers, found {' '.join(words)[:60]!r}") from error


def parse_numbers(path: Path, line: int, words: list[str]) -> list[float]:
    """Read finite numbers. Raises SourceError naming file and line."""
    values = parse_any_numbers(path, line, words)
    if not np.isfinite(values).all():
        raise SourceError(f"{path}:{line}: not finite: {' '.join(words)!r}; delete the line")
    return values


Times = NDArray[np.float64]

MAX_GAP_S = 0.02
"""Largest time difference of a colour and a depth image of one camera at 30 Hz; TUM's own tool uses the same."""

UNIT_RATIO = 200.0
"""Median steps of two lists that differ by this factor are in different units, such as s and ms."""

MOST_CANDIDATES = 100
"""Largest mean number of images that may be within the tolerance of an image: a camera of 1000 Hz has 40. Equal times
would need memory for the square of the number of images."""


def associate(first_s: Times, second_s: Times, tolerance_s: float = MAX_GAP_S) -> NDArray[np.intp]:
    """Pair timestamps [N] and [M], seconds, that differ by less than `tolerance_s`; return indices [K, 2] by time.

    Every index is used at most once, and the closest pairs are chosen first. The lists may be unsorted. Ties go to the
    earlier entry of the first list, then of the second, so the result does not depend on the sorting algorithm. Raises
    SourceError if so many times are equal that they cannot pair images.
    """
    rows, columns = _near_pairs(first_s, second_s, tolerance_s)
    gaps_s = np.abs(first_s[rows] - second_s[columns])
    used_first, used_second = np.zeros(len(first_s), bool), np.zeros(len(second_s), bool)
    pairs = []
    for k in np.lexsort((columns, rows, gaps_s)):
        i, j = rows[k], columns[k]
        if not (used_first[i] or used_second[j]):
            used_first[i] = used_second[j] = True
            pairs.append((i, j))
    pairs.sort(key=lambda pair: (first_s[pair[0]], pair[0]))
    return np.array(pairs, np.intp).reshape(-1, 2)


def pair_times(path: Path, times_s: Mapping[str, Times]) -> tuple[list[tuple[int, int]], list[int]]:
    """Pair two kinds of images of a recording by time; return the index pairs by time, and the first images left alone.

    times_s: of colour and depth, or left and right, by name, seconds [N] and [M]. Raises SourceError if their units
    differ, or nothing pairs.
    """
    first_s, second_s = times_s.values()
    refuse_other_units(path, times_s)
    pairs = [(int(i), int(j)) for i, j in associate(first_s, second_s)]
    if not pairs:
        raise no_pairs(path, times_s)
    paired = {i for i, _ in pairs}
    return pairs, [i for i in range(len(first_s)) if i not in paired]


def no_pairs(path: Path, times_s: Mapping[str, Times]) -> SourceError:
    """Return the error for a recording in which no colour image has depth; `times_s` of colour and depth by name."""
    spans = ", ".join(f"{name} {t.min():.3f} … {t.max():.3f} s" for name, t in times_s.items())
    return SourceError(
        f"no colour image of {path} has depth within {MAX_GAP_S:g} s ({spans}); are both from one recording?"
    )


def refuse_other_units(path: Path, times_s: Mapping[str, Times]) -> None:
    """Raise SourceError if the steps of two lists of times differ so much that their units do."""
    steps = {name: float(np.median(np.abs(np.diff(t)))) for name, t in times_s.items() if len(t) > 2}
    if len(steps) < 2 or min(steps.values()) <= 0 or max(steps.values()) < UNIT_RATIO * min(steps.values()):
        return
    found = ", ".join(f"{name} {step:.6g}" for name, step in steps.items())
    raise SourceError(f"{path}: times are in different units (median steps: {found}); write both in seconds")


def nearest_gaps_s(first_s: Times, second_s: Times) -> Times:
    """Return the time from each of the first times to the nearest of the second, seconds [N]."""
    return np.asarray(cKDTree(second_s[:, None]).query(first_s[:, None])[0])


def _near_pairs(first_s: Times, second_s: Times, tolerance_s: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    first, second = (cKDTree(times_s[:, None]) for times_s in (first_s, second_s))
    found = int(first.count_neighbors(second, tolerance_s, 1))
    if found > MOST_CANDIDATES * (len(first_s) + len(second_s)):
        raise SourceError(
            f"{len(first_s)} and {len(second_s)} images have {found} pairs of times within {tolerance_s:g} s, so their "
            "times do not pair them; give every image its own time, in seconds"
        )
    pairs = first.sparse_distance_matrix(second, tolerance_s, 1, output_type="ndarray")
    near = pairs[pairs["v"] < tolerance_s]
    return near["i"], near["j"]
