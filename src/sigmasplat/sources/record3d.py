"""Read what the app Record3D records with an iPhone: .r3d files, and folders of its export "EXR + RGB".

.r3d is a zip: metadata (JSON)   rgbd/0.jpg   rgbd/0.depth, rgbd/0.conf: LZFSE of float32 metres and of bytes
the export:    metadata.json     rgb/0.jpg    depth/0.exr

metadata: w, h, dw, dh (sizes in pixels), K (3×3 by columns), fps, frameTimestamps (seconds), perFrameIntrinsicCoeffs
(fx, fy, cx, cy), poses (qx, qy, qz, qw, x, y, z of the camera, in OpenGL's axes). Layout: marek-simonik/record3d,
issues 7 and 27; nerfstudio, record3d_utils.py. Depth is the colour camera's view on a coarser grid; confidence is 0, 1,
2, and readings of 0 are left out.
"""

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.errors import SourceError
from sigmasplat.model import se3
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.sources.camera.calibration import Calibration, build_camera, json_number, resolve_calibration
from sigmasplat.sources.files.archive import Archive
from sigmasplat.sources.files.images import decode_color, depth_to_metres, image_size
from sigmasplat.sources.files.optional import import_optional
from sigmasplat.sources.opening import Format
from sigmasplat.sources.recorded import ImagePair, RecordedSource, Size
from sigmasplat.sources.stray_scanner import with_coarser_depth

FLIPPED = np.diag([1.0, -1.0, -1.0, 1.0])
"""Takes our camera axes (y down, z forward) to OpenGL's (y up, z backward)."""


@dataclass(frozen=True)
class R3dImagePair(ImagePair):
    """One frame of a .r3d: three members of the archive."""

    archive: Archive
    number: int
    depth_size: Size
    lzfse: Any

    def read_color(self) -> NDArray[np.uint8]:
        """Read 8-bit RGB [H, W, 3]. Raises SourceError naming the member."""
        return decode_color(self.color, self.archive.read(f"rgbd/{self.number}.jpg"))

    def read_depth(self, units_per_metre: float) -> NDArray[np.float32]:
        """Read depth in metres [H, W], 0 where the phone had no confidence. Raises SourceError naming the member."""
        depth_m = self._unpacked("depth", np.float32)
        depth_m = np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0)
        name = f"rgbd/{self.number}.conf"
        if name in self.archive:
            depth_m = np.where(self._unpacked("conf", np.uint8) > 0, depth_m, np.float32(0.0))
        return depth_to_metres(self.depth, depth_m, units_per_metre)

    def sizes(self) -> tuple[Size, Size]:
        """Return (width, height) of colour and depth. Raises SourceError naming the colour image."""
        height, width = self.read_color().shape[:2]
        return (width, height), self.depth_size

    def _unpacked(self, ending: str, kind: type[np.generic]) -> NDArray[Any]:
        name, (width, height) = f"rgbd/{self.number}.{ending}", self.depth_size
        where, data = self.archive.path / name, self.archive.read(name)
        try:
            return np.frombuffer(self.lzfse.decompress(data), kind).reshape(height, width)
        except (self.lzfse.error, ValueError, MemoryError) as error:  # it asks for memory without end where cut short
            raise SourceError(f"{where}: not {width}×{height} values in LZFSE ({error}); export it again") from error


@dataclass(frozen=True)
class ExrImagePair(ImagePair):
    """One frame of the export: a picture and an EXR file."""

    openexr: Any

    def read_depth(self, units_per_metre: float) -> NDArray[np.float32]:
        """Read depth in metres [H, W]. Raises SourceError naming the file."""
        channels = self._opened().channels()
        name = next((name for name in ("R", "Y", "Z") if name in channels), next(iter(channels)))
        depth_m = np.asarray(channels[name].pixels, np.float32)
        return depth_to_metres(self.depth, np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0), units_per_metre)

    def sizes(self) -> tuple[Size, Size]:
        """Return (width, height) of colour and depth. Raises SourceError naming the file."""
        low, high = self._opened().header()["dataWindow"]
        return image_size(self.color), (int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1)

    def _opened(self) -> Any:
        try:
            return self.openexr.File(str(self.depth), separate_channels=True)
        except Exception as error:  # the library raises whatever its C++ does
            raise SourceError(f"{self.depth}: unreadable EXR file ({error}); export it again") from error


def open_record3d(path: Path, settings: InputConfig) -> RecordedSource:
    """Open a .r3d file, an unpacked one, or an export; raises SourceError if metadata or images cannot be used."""
    archive = Archive(path)
    name = "metadata.json" if "metadata.json" in archive else "metadata"
    metadata = _metadata(archive, name)
    native = archive.numbered("rgbd", "depth")
    colors = archive.numbered("rgbd", "jpg") if native else archive.numbered("rgb", "jpg|png")
    depths = native or archive.numbered("depth", "exr")
    numbers = sorted(colors.keys() & depths.keys())
    if not numbers:
        raise SourceError(
            f"no depth images in {path} (looked for rgbd/0.depth and depth/0.exr beside the pictures); "
            "export it as Shareable/Internal format (.r3d) or EXR + RGB"
        )
    times_s = _times_s(path / name, metadata, numbers)
    pairs = [(float(t), path / colors[n], path / depths[n]) for t, n in zip(times_s, numbers, strict=True)]
    images: Sequence[ImagePair]
    if native:
        lzfse = import_optional("lzfse", "iphone", f"{path}: depth of Record3D")
        size = _depth_size(path / name, metadata)
        images = [R3dImagePair(*pair, archive, n, size, lzfse) for pair, n in zip(pairs, numbers, strict=True)]
    else:
        openexr = import_optional("OpenEXR", "iphone", f"{path}: depth of Record3D")
        images = [ExrImagePair(*pair, openexr) for pair in pairs]
    calibration = _calibration(path, path / name, metadata, images, settings)
    skipped = [f"{path / colors[n]}: no depth {n} beside it" for n in sorted(colors.keys() - depths.keys())]
    truth = _truth(path / name, metadata, numbers, times_s)
    return RecordedSource(path.resolve().stem, images, calibration, settings, truth, skipped)


def _metadata(archive: Archive, name: str) -> dict[str, Any]:
    try:
        content = json.loads(archive.read(name))
    except ValueError as error:
        raise SourceError(f"{archive.path / name}: not readable as JSON ({error}); export it again") from error
    if not isinstance(content, dict):
        raise SourceError(f"{archive.path / name}: holds a {type(content).__name__}, not an object with K, w, h")
    return content


def _depth_size(path: Path, metadata: dict[str, Any]) -> Size:
    """Return (width, height) of depth; files of before metadata said it have a LiDAR's 256×192, turned as colour is."""
    width, height = (int(json_number(path, metadata, key)) for key in ("w", "h"))
    wide = (256, 192) if width > height else (192, 256)
    return int(json_number(path, metadata, "dw", wide[0])), int(json_number(path, metadata, "dh", wide[1]))


def _calibration(
    path: Path, where: Path, metadata: dict[str, Any], images: Sequence[ImagePair], settings: InputConfig
) -> Calibration:
    """Read the camera, scaled to the pictures: exports hold them larger than metadata says."""
    size, depth_size = _first_sizes(images)
    width, height = (int(json_number(where, metadata, key, value)) for key, value in zip(("w", "h"), size, strict=True))
    focal = _rows(where, metadata, "perFrameIntrinsicCoeffs", 4)
    if focal is not None and len(focal):
        middle = np.median(focal, 0).tolist()
    else:
        k = _rows(where, {"K": [metadata.get("K")]}, "K", 9) if metadata.get("K") else None
        middle = [float(k[0][i]) for i in (0, 4, 6, 7)] if k is not None else None
    recorded = Calibration(build_camera(where, width, height, middle).resized(*size), 1.0) if middle else None
    return with_coarser_depth(resolve_calibration(path, recorded, size, settings, 1.0), depth_size)


def _first_sizes(images: Sequence[ImagePair]) -> tuple[Size, Size]:
    problem: SourceError | None = None
    for image in images:
        try:
            return image.sizes()
        except SourceError as error:
            problem = problem or error
    raise SourceError(f"no pair of colour and depth can be read (first: {problem})")


def _times_s(where: Path, metadata: dict[str, Any], numbers: list[int]) -> NDArray[np.float64]:
    """Return the frames' times, of a steady rate where none are recorded. Raises SourceError."""
    times = metadata.get("frameTimestamps")
    if isinstance(times, list) and len(times) > numbers[-1]:
        values = [json_number(where, {"frameTimestamps": times[n]}, "frameTimestamps") for n in numbers]
        return np.array(values)
    return np.array(numbers) / (json_number(where, metadata, "fps", 60.0) or 60.0)


def _truth(
    where: Path, metadata: dict[str, Any], numbers: list[int], times_s: NDArray[np.float64]
) -> Trajectory | None:
    """Return ARKit's path: not the truth, but what the phone believed of itself; the front camera has none."""
    poses = _rows(where, metadata, "poses", 7)
    if poses is None or len(poses) <= numbers[-1] or np.ptp(poses, 0).max() == 0:
        return None
    T = np.tile(np.eye(4), (len(numbers), 1, 1))
    lengths = np.linalg.norm(poses[:, :4], axis=1)
    if (np.abs(lengths - 1.0) > 1e-2).any():
        n = int(np.argmax(np.abs(lengths - 1.0)))
        raise SourceError(f"{where}: pose {n} is not rigid: its quaternion has length {lengths[n]:.4g}, not 1")
    T[:, :3, :3] = se3.rotation_from_quaternion(poses[numbers][:, [3, 0, 1, 2]])
    T[:, :3, 3] = poses[numbers, 4:]
    return Trajectory(times_s, T @ FLIPPED)


def _rows(where: Path, metadata: dict[str, Any], key: str, count: int) -> NDArray[np.float64] | None:
    """Read rows of `count` numbers, None where there are none. Raises SourceError naming file and field."""
    if not metadata.get(key):
        return None
    try:
        rows = np.array(metadata[key], np.float64)
    except (TypeError, ValueError):
        rows = np.zeros(0)
    if rows.ndim != 2 or rows.shape[1] != count or not np.isfinite(rows).all():
        raise SourceError(f'{where}: field "{key}" is no list of {count} finite numbers each; export it again')
    return rows


def _recognises(path: str) -> bool:
    place = Path(path)
    if place.is_file():
        try:
            with zipfile.ZipFile(place) as archive:
                return any(name.startswith("rgbd/") for name in archive.namelist())
        except (OSError, zipfile.BadZipFile):
            return place.suffix.lower() == ".r3d"
    return any((place / "rgbd").glob("*.depth")) or (
        (place / "metadata.json").is_file() and any((place / "depth").glob("*.exr"))
    )


FORMAT = Format(
    "Record3D",
    "a .r3d file, or metadata.json with rgb/ and depth/*.exr",
    _recognises,
    lambda path, settings: open_record3d(Path(path), settings),
)
