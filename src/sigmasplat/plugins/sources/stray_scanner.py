"""Read LiDAR recordings of the iPhone app Stray Scanner (layout: strayrobots/scanner, docs/format.md).

rgb.mp4                       depth/000000.png    16-bit millimetres, fewer pixels, same camera
camera_matrix.csv   3×3       confidence/000000.png   0, 1 or 2: readings with 0 are ignored
odometry.csv        timestamp, frame, x, y, z, qx, qy, qz, qw [, fx, fy, cx, cy]
imu.csv             timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z; optional
                    alpha: angular velocity, rad/s; a: of CMAccelerometerData in g, −1 upwards at rest

The app converts ARKit's camera axes to ours before it writes a pose (OdometryEncoder.swift). Frame, depth and pose
share one number. The clock of imu.csv is that of the frames, and its axes are those of the phone (IMUEncoder.swift,
DatasetEncoder.swift). Recordings of 2021, whose odometry.csv has no header, are not supported.
"""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sigmasplat.api as api
from sigmasplat.api import Calibration, SourceError, Trajectory, se3

POSE = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
ANGULAR, LINEAR = ("alpha_x", "alpha_y", "alpha_z"), ("a_x", "a_y", "a_z")
R_CAMERA_PHONE = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""To the camera's axes from those of the phone. Held upright, the phone has x right, y up and z towards the user. The
image's x points from the top of the phone to its bottom (ARKit's camera axes, with y and z reversed)."""
INTRINSICS = ("fx", "fy", "cx", "cy")
Rows = dict[int, dict[str, float]]


def open_stray_scanner(path: str, settings: api.InputConfig) -> api.RecordedSource:
    """Open a folder. Raises SourceError if video, depth, camera or poses cannot be used."""
    folder = Path(path)
    video_path = folder / "rgb.mp4"
    depths = {int(path.stem): path for path in sorted((folder / "depth").glob("*.png")) if path.stem.isdecimal()}
    if not video_path.is_file():
        raise SourceError(f"no video in {folder} (looked for rgb.mp4); copy the whole folder from the phone")
    if not depths:
        raise SourceError(f"no depth images in {folder} (looked for depth/000000.png, …); does the phone have a LiDAR?")
    rows, video = _odometry(folder / "odometry.csv"), api.Video(video_path)
    numbers = [n for n in sorted(depths) if n in rows and n < video.count]
    if not numbers:
        raise SourceError(
            f"{folder}: no frame has video ({video.count} frames), depth and a line of odometry.csv "
            f"({len(rows)} lines); copy the whole folder again"
        )
    images = [
        api.ImagePair(rows[n]["timestamp"], folder / f"rgb.mp4 frame {n}", depths[n], video=(video, n),
                  confidence=folder / "confidence" / depths[n].name)
        for n in numbers
    ]  # fmt: skip
    skipped = [f"{depths[n]}: no frame {n} in rgb.mp4 or odometry.csv" for n in sorted({*depths} - {*numbers})]
    used, (moved_s, rates, forces) = [rows[n] for n in numbers], _imu(folder / "imu.csv")
    times_s, known = np.array([row["timestamp"] for row in used]), _calibration(folder, used, video.size)
    known = known and replace(known, origins={**known.origins, "depth unit": api.DEFINED})
    truth, gyroscope = _truth(times_s, used), api.gyroscope_from_samples(moved_s, rates)
    if gyroscope and not gyroscope.measured_any(times_s):
        gyroscope = None
    return api.folder_source(
        folder, settings, images, known, api.MM_PER_METRE, truth, skipped, one_camera=True, estimated="ARKit",
        gyroscope=gyroscope, accelerometer=api.accelerometer_from_samples(moved_s, forces),
    )  # fmt: skip


def _odometry(path: Path) -> Rows:
    if not path.is_file():
        raise SourceError(f"{path} is missing: it holds the times of the frames; copy the whole folder again")
    lines = api.csv_rows(path)
    _, names = next(lines, (0, []))
    if not set(POSE) <= set(names):
        raise SourceError(
            f"{path}: expected columns {', '.join(POSE)} in the first line, found {', '.join(names)[:200]}; "
            "record with a Stray Scanner of 2022 or later"
        )
    rows = {}
    for number, line in lines:
        where, found = f"{path}:{number}", f"{','.join(line)[:80]!r}"
        try:
            row = {name: float(word) for name, word in zip(names, line, strict=True)}
        except ValueError as error:
            raise SourceError(f"{where}: expected {len(names)} numbers, found {found}") from error
        if not np.isfinite(list(row.values())).all():
            raise SourceError(f"{where}: not finite: {found}; delete the line")
        rows[int(row["frame"])] = row
    return rows


def _calibration(folder: Path, rows: list[dict[str, float]], size: api.Size) -> Calibration | None:
    """Read the camera: the median of all frames if they have intrinsics, because autofocus changes them slightly."""
    path, focals = folder / "camera_matrix.csv", [[row[name] for name in INTRINSICS if name in row] for row in rows]
    if len(focals[0]) == len(INTRINSICS):
        return api.median_calibration(folder / "odometry.csv", size, np.array(focals), api.MM_PER_METRE)
    if path.is_file() and not (known := api.read_intrinsics(path, size, api.MM_PER_METRE)):
        raise SourceError(f"{path}: expected a 3×3 matrix; copy it again")
    return known if path.is_file() else None


def _truth(times_s: NDArray[np.float64], rows: list[dict[str, float]]) -> Trajectory:
    """Return ARKit's path: an estimate by the phone, not ground truth."""
    poses, values = np.tile(np.eye(4), (len(rows), 1, 1)), np.array([[row[name] for name in POSE] for row in rows])
    poses[:, :3, :3], poses[:, :3, 3] = se3.rotation_from_quaternion(values[:, [8, 5, 6, 7]]), values[:, 2:5]
    return Trajectory(times_s, poses)


def _imu(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Read times [M], angular velocities and specific forces [M, 3] along the camera's axes; Apple's sign is that of
    gravity. What is missing or cannot be read is nan: the app may be stopped while it writes a line."""
    lines = api.csv_rows(path, errors="replace") if path.is_file() else iter(())
    _, header = next(lines, (0, []))
    samples = []
    for _, line in lines:
        words = dict(zip(header, line, strict=False))
        samples.append([_number(words.get(name)) for name in ("timestamp", *ANGULAR, *LINEAR)])
    values = np.array(samples).reshape(-1, 7)
    rates, forces = values[:, 1:4], -api.GRAVITY_M_S2 * values[:, 4:]
    return values[:, 0], rates @ R_CAMERA_PHONE.T, forces @ R_CAMERA_PHONE.T


def _number(word: str | None) -> float:
    with suppress(ValueError):
        return np.nan if word is None else float(word)
    return np.nan


def _recognises(path: str) -> bool:
    folder = Path(path)
    return (folder / "odometry.csv").is_file() or ((folder / "rgb.mp4").is_file() and (folder / "depth").is_dir())


PLUGIN = api.SourceFormat(
    "Stray Scanner", "rgb.mp4, depth/ and odometry.csv", _recognises, open_stray_scanner, sensor="lidar-iphone"
)
