"""Read text files of numbers and poses, and pair times; each problem becomes a SourceError that names file and line."""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from sigmasplat.config import InputConfig
from sigmasplat.data import se3
from sigmasplat.data.trajectory import MOST_M, Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.files.reading import exists, read_text
from sigmasplat.input.calibration import ASSUMED, Origin
from sigmasplat.input.images import dated_seconds
from sigmasplat.types import Matrix

MOST_MATRIX_BYTES = 1 << 16
RIGID_TOLERANCE, QUATERNION_TOLERANCE = 1e-2, 1e-2
"""Published poses are rounded; a matrix within this tolerance of a rotation is orthonormalised, and the length of a
quaternion may differ from 1 by this."""
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

    Raises SourceError naming `where` if the matrix is finite but not rigid, or too far from the origin.
    """
    if not np.isfinite(T).all():
        return None
    if (far_m := np.abs(T[:3, 3]).max()) > MOST_M:
        raise SourceError(
            f"{where}: the pose is {far_m:.3g} m from the origin, more than {MOST_M:g}; delete or correct it"
        )
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
    """Read TUM's lines "t tx ty tz qx qy qz qw"; a whole number before or after is an id, a header may put qw first.
    Raises SourceError naming a line that is not finite or not rigid, or if there is none, unless it `may_be_empty`."""
    lines, rows = list(read_lines(path)), list[list[float]]()
    lines = lines[not re.match(r"[-+.\d]|nan|inf", lines[0][1][0], re.IGNORECASE) :] if lines else []  # no header
    for id_column, first in ((8, 0), (0, 1)):
        if all(len(words) == 9 and words[id_column].isdecimal() for _, words in lines):
            lines = [(line, words[first : first + 8]) for line, words in lines]
    for line, words in lines:
        if len(words) != 8:
            remedy = "; remove the columns that are none of these" * (len(words) > 8)
            raise SourceError(f"{path}:{line}: expected 't tx ty tz qx qy qz qw', found {len(words)} values{remedy}")
        rows.append(parse_numbers(path, line, words))
    if not rows and not may_be_empty:
        raise SourceError(f"{path}: holds no poses; delete it or add poses")
    table, T = np.array(rows, np.float64).reshape(-1, 8), np.tile(np.eye(4), (len(rows), 1, 1))
    if re.match(r"\W*[a-z].*\bq\w*w\b.*\bq\w*x\b", read_text(path).partition("\n")[0], re.IGNORECASE):
        table = table[:, [0, 1, 2, 3, 5, 6, 7, 4]]
    for (line, _), length in zip(lines, np.linalg.norm(table[:, 4:], axis=1), strict=True):
        _refuse_unless_unit(f"{path}:{line}", length)
    T[:, :3, :3], T[:, :3, 3] = se3.rotation_from_quaternion(table[:, [7, 4, 5, 6]]), table[:, 1:4]
    return Trajectory(dated_seconds(table[:, 0]), T)


def read_groundtruth(folder: Path) -> Trajectory | None:
    """Read groundtruth.txt of a folder as `read_poses` does, None without one. Formats read it on opening: damage must
    stop the run before it starts, not its evaluation an hour later."""
    path = folder / "groundtruth.txt"
    return read_poses(path) if exists(path) else None


POSES = re.compile(r"(cam(era)?_?)?(poses?|traj(ectory)?|odometry)[-\w]*\.(txt|csv|log)")


def poses_beside(folder: Path) -> dict[str, Origin]:
    """Return that a file of a folder that is named as poses are is not read, with what reads it; empty without one."""
    path = next((path for path in sorted(folder.glob("*.*")) if POSES.fullmatch(path.name.lower())), None)
    return {"poses": Origin(f"none, {path.name} is not read", ASSUMED, f"--poses {path}")} if path else {}


def read_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number from 1, words) of every line that is not empty or a comment."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split("#")[0].replace(",", " ").split()
        if words:
            yield number, words


def read_listed(path: Path, form: str) -> Iterator[tuple[list[float], list[Path]]]:
    """Yield times and image files of each line; form: "time path", or "time path time path". Raises SourceError without
    lines, or naming one of another form."""
    lines = [(i, line.strip(" ,\t")) for i, line in enumerate(read_text(path).split("\n"), 1)]
    lines = [(i, line) for i, line in lines if line and not line.startswith("#")]
    lines = lines[bool(lines) and lines[0][1].lower().startswith("time") :]  # a header
    if not lines:
        raise SourceError(f"{path}: lists no images")
    ids = all(re.fullmatch(r"\d+[\s,]+[\d.]+[\s,]+\S*[^\d\s]\S*", line) for _, line in lines)
    pattern = r"([^\s,]+)[\s,]+(\S.*?)" + r"[\s,]+([-+.\deE]+)[\s,]+(\S.*?)" * (form.count("path") - 1)
    pattern = r"\d+[\s,]+" * ids + pattern
    for i, line in lines:
        if not (found := re.fullmatch(pattern, line)):
            raise SourceError(f"{path}:{i}: expected {form!r}, found {line[:60]!r}")
        names = [listed_file(path.parent, name) for name in found.groups()[1::2]]
        yield parse_numbers(path, i, list(found.groups()[::2])), names


def listed_file(folder: Path, written: str) -> Path:
    """Return the file that a list in a folder names: as written, else without a comment, with "\\" as a separator,
    by the last two parts of an absolute path, which was another machine's, and without further columns."""
    name = PureWindowsPath(re.sub(r"\s+#.*", "", written).strip("\"'"))
    tries = [folder / written, folder / name.as_posix(), folder.joinpath(*name.parts[-2 if name.anchor else 0 :])]
    tries += [folder / re.split(r"[\s,]", name.as_posix())[0]]
    return next((path for path in tries if path.is_file()), tries[1])


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

MAX_GAP_S = InputConfig.max_gap_s
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


def pair_times(path: Path, times_s: Mapping[str, Times], settings: InputConfig) -> tuple[NDArray[np.intp], list[int]]:
    """Pair two kinds of images of a recording by time; return index pairs [K, 2] by time, and first ones left alone.

    times_s: of colour and depth, or left and right, by name, seconds [N] and [M], the second without
    `input.depth_delay_s`. Raises SourceError as `refuse_unpaired`.
    """
    first_s, second_s = times_s.values()
    pairs = associate(first_s, second_s, settings.max_gap_s)
    refuse_unpaired(path, times_s, len(pairs), settings)
    return pairs, sorted({*range(len(first_s))} - {*pairs[:, 0].tolist()})


def time_origins(settings: InputConfig, how: str, origin: str, option: str = "") -> dict[str, Origin]:
    """Return where the pairs of a recording come from: `how` they were made, from which times."""
    delay = f", depth stamped {settings.depth_delay_s:g} s late" * bool(settings.depth_delay_s)
    return {"pairs": Origin(f"{how}, within {settings.max_gap_s:g} s{delay}", origin, option)}


def refuse_unpaired(path: Path, times_s: Mapping[str, Times], pairs: int, settings: InputConfig) -> None:
    """Raise SourceError if the units of times differ, or there are no pairs, or few because of a constant delay: it
    names the delay and the settings that correct it. `times_s` as for `pair_times`."""
    refuse_other_units(path, times_s)
    first_s, second_s = times_s.values()
    common = min(np.sum((a >= b.min()) & (a <= b.max())) for a, b in ((first_s, second_s), (second_s, first_s)))
    if 2 * pairs > common:
        return
    delay_s, step_s = _delay_s(first_s, second_s, settings.max_gap_s)
    if pairs and delay_s is None:
        return
    remedy = "are both from one recording?"
    if delay_s is not None:
        whole_s, gap_s = delay_s + settings.depth_delay_s, abs(delay_s) + step_s / 8
        remedy += f" then depth is stamped {whole_s:.3f} s late: --set input.depth_delay_s={whole_s:.3f}"
        remedy += f" (or pair them as they are: --set input.max_gap_s={gap_s:.3f})" * (abs(delay_s) < step_s / 2)
    spans = ", ".join(f"{name} {t.min():.3f} … {t.max():.3f} s" for name, t in times_s.items())
    subject = f"only {pairs} colour images of {path} have" if pairs else f"no colour image of {path} has"
    raise SourceError(f"{subject} depth within {settings.max_gap_s:g} s ({spans}); {remedy}")


def _delay_s(first_s: Times, second_s: Times, most_s: float) -> tuple[float | None, float]:
    """Return by how much nearly all of the second times are later, None if by no constant, and their step, seconds."""
    few, many = sorted((first_s, second_s), key=len)
    step_s = max(1e-9, min(float(np.median(np.abs(np.diff(t)))) if len(t) > 1 else 0.0 for t in (few, many)))

    def rest_s(shift_s: float) -> Times:
        gaps_s = nearest_gaps_s(few + shift_s, many)
        return gaps_s[np.abs(gaps_s) < min(step_s / 8, most_s)]

    shifts = many - few[len(few) // 2]  # clocks may differ by years: also the first to the first, the last to the last
    shifts = sorted([*sorted(shifts, key=abs)[:100], many[0] - few[0], many[-1] - few[-1]], key=abs)
    best = max(shifts, key=lambda s: len(rest_s(s)) / (1 + 0.02 * abs(s) / step_s + (abs(s) > step_s)))
    if len(rest_s(best)) <= max(2, 0.8 * len(few)):
        return None, step_s
    return float(best + np.median(rest_s(best))) * (1 if many is second_s else -1), step_s


def refuse_other_units(path: Path, times_s: Mapping[str, Times]) -> None:
    """Raise SourceError if the steps of two lists of times differ so much that their units do."""
    steps = {name: float(np.median(np.abs(np.diff(t)))) for name, t in times_s.items() if len(t) > 2}
    if len(steps) < 2 or min(steps.values()) <= 0 or max(steps.values()) < UNIT_RATIO * min(steps.values()):
        return
    found = ", ".join(f"{name} {step:.6g}" for name, step in steps.items())
    raise SourceError(f"{path}: times are in different units (median steps: {found}); write both in seconds")


def nearest_gaps_s(first_s: Times, second_s: Times) -> Times:
    """Return by how much the nearest of the second times is later than each of the first times, seconds [N]."""
    return np.asarray(second_s[cKDTree(second_s[:, None]).query(first_s[:, None])[1]] - first_s)


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
