"""Read iPhone recordings of the app Record3D: .r3d files, and folders of its export "EXR + RGB".

.r3d is a zip: metadata (JSON)   rgbd/0.jpg   rgbd/0.depth, rgbd/0.conf: LZFSE of float32 metres and of bytes;
               also packed again with its folder, or alone in a folder
the export:    metadata.json     rgb/0.jpg    depth/0.exr

metadata: w, h, dw, dh (sizes in pixels), K (3×3 by columns), fps, frameTimestamps (seconds), perFrameIntrinsicCoeffs
(fx, fy, cx, cy), poses (qx, qy, qz, qw, x, y, z of the camera, in OpenGL's axes). Layout: marek-simonik/record3d,
issues 7 and 27; nerfstudio, record3d_utils.py. Depth has fewer pixels than colour, but the same camera; confidence is
0, 1 or 2, and readings with confidence 0 are ignored.
"""

import re
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sigmasplat.api as api
from sigmasplat.api import ImagePair, Size, SourceError, Trajectory

MOST_MEMBER_BYTES = 128 << 20
"""Largest file of an archive after unzipping: an image, or its depth."""


class Archive:
    """The files of a zip archive or of its unpacked folder, by name beside the metadata; none are unpacked."""

    def __init__(self, path: Path) -> None:
        """List the files. Raises SourceError if a file is not a complete zip archive."""
        self.path, self._zip = path, None
        if path.is_dir():
            self.names = [str(entry.relative_to(path)) for part in ("*", "*/*") for entry in path.glob(part)]
            return
        with api.guarded(path, "copy it again", SourceError, "not a complete zip archive"):
            self._zip = zipfile.ZipFile(path)
        listed = self._zip.namelist()
        self._inner = next((n.removesuffix("metadata") for n in listed if n.endswith("/metadata")), "")
        self.names = [name.removeprefix(self._inner) for name in listed]

    def read(self, name: str, most: int = MOST_MEMBER_BYTES) -> bytes:
        """Return the bytes of a file. Raises SourceError naming it if it is missing, damaged, encrypted, or has more
        than `most` bytes."""
        where = self.path / name
        if self._zip is None:
            return api.read_bytes(where, SourceError, most)
        failed = "cannot be read from its archive"
        with api.guarded(where, "copy it again", SourceError, failed), self._zip.open(self._inner + name) as member:
            data = member.read(most + 1)
        if len(data) > most:
            raise SourceError(f"{where}: unzips to more than {most / 1e6:.0f} MB; is it the right file?")
        return data

    def by_number(self, folder: str, endings: str) -> dict[int, str]:
        """Map N to each name folder/N.ending, in order of N; `endings` is a regular expression such as "jpg|png"."""
        found = [(re.fullmatch(rf"{folder}/(\d+)\.({endings})", name), name) for name in self.names]
        return dict(sorted((int(match.group(1)), name) for match, name in found if match))


@dataclass(frozen=True)
class R3dImagePair(ImagePair):
    """One frame of a .r3d file: three members of the archive."""

    archive: Archive
    number: int
    depth_size: Size
    lzfse: Any

    def read_color(self) -> NDArray[np.uint8]:
        return api.read_color(self.color, self.archive.read(f"rgbd/{self.number}.jpg"))

    def read_depth(self, units_per_metre: float) -> NDArray[np.float32]:
        """Read depth in metres [H, W], 0 at confidence 0. Raises SourceError naming the member."""
        depth_m = api.without_nan(self._unpacked("depth", np.float32))
        name = f"rgbd/{self.number}.conf"
        if name in self.archive.names:
            depth_m = np.where(self._unpacked("conf", np.uint8) > 0, depth_m, np.float32(0.0))
        return api.depth_to_metres(self.depth, depth_m, units_per_metre)

    def sizes(self) -> tuple[Size, Size]:
        height, width = self.read_color().shape[:2]
        return (width, height), self.depth_size

    def _unpacked(self, ending: str, kind: type[np.generic]) -> NDArray[Any]:
        name, (width, height) = f"rgbd/{self.number}.{ending}", self.depth_size
        where, data = self.archive.path / name, self.archive.read(name)
        try:
            return np.frombuffer(self.lzfse.decompress(data), kind).reshape(height, width)
        except (self.lzfse.error, ValueError, MemoryError) as error:  # truncated data can request very much memory
            raise SourceError(
                f"{where}: not {width}×{height} LZFSE-compressed values ({error}); export it again"
            ) from error


def open_record3d(place: str, settings: api.InputConfig) -> api.RecordedSource:
    """Open a .r3d file, packed or unpacked, or an export. Raises SourceError if metadata or images cannot be used."""
    path = _packed(Path(place))
    archive = Archive(path)
    name = "metadata.json" if "metadata.json" in archive.names else "metadata"
    metadata = api.parse_json(archive.read(name, api.MOST_JSON_BYTES), path / name)
    if not isinstance(metadata, dict):
        raise SourceError(f"{path / name}: holds a {type(metadata).__name__}, not an object with K, w, h")
    native = archive.by_number("rgbd", "depth")
    colors = archive.by_number("rgbd", "jpg") if native else archive.by_number("rgb", "jpg|png")
    depths = native or archive.by_number("depth", "exr")
    numbers = sorted(colors.keys() & depths.keys())
    if not numbers:
        raise SourceError(
            f"no depth images in {path} (looked for rgbd/0.depth and depth/0.exr beside the images); "
            "export it as Shareable/Internal format (.r3d) or EXR + RGB"
        )
    times_s = _times_s(path / name, metadata, numbers)
    pairs = [(float(t), path / colors[n], path / depths[n]) for t, n in zip(times_s, numbers, strict=True)]
    images: Sequence[ImagePair] = [ImagePair(*pair) for pair in pairs]
    if native:
        lzfse = api.import_optional("lzfse", "iphone", f"{path}: depth of Record3D")
        size = _depth_size(path / name, metadata)
        images = [R3dImagePair(*pair, archive, n, size, lzfse) for pair, n in zip(pairs, numbers, strict=True)]
    known = _calibration(path / name, metadata, images, numbers)
    skipped = [f"{path / colors[n]}: no depth image {n}" for n in sorted(colors.keys() - depths.keys())]
    truth = _truth(path / name, metadata, numbers, times_s)
    return api.folder_source(
        path, settings, images, known, 1.0, truth, skipped, path.resolve().stem, one_camera=True, estimated="ARKit"
    )


def _depth_size(path: Path, metadata: dict[str, Any]) -> Size:
    """Return (width, height) of depth; older files lack it and have the LiDAR's 256×192, rotated like colour."""
    width, height = (int(api.json_number(path, metadata, key)) for key in ("w", "h"))
    wide = (256, 192) if width > height else (192, 256)
    return int(api.json_number(path, metadata, "dw", wide[0])), int(api.json_number(path, metadata, "dh", wide[1]))


def _calibration(
    where: Path, metadata: dict[str, Any], images: Sequence[ImagePair], numbers: list[int]
) -> api.Calibration | None:
    """Read the camera, scaled to the image size, which is larger in exports than in the metadata."""
    size, _ = api.first_readable(images, lambda pair: pair.sizes())
    width, height = (
        int(api.json_number(where, metadata, key, value)) for key, value in zip(("w", "h"), size, strict=True)
    )
    focal = _rows(where, metadata, "perFrameIntrinsicCoeffs", 4)
    if focal is None:
        k = _rows(where, {"K": [metadata.get("K")]}, "K", 9) if metadata.get("K") else None
        focal = None if k is None else k[:, [0, 4, 6, 7]]
    if focal is None:
        return None
    focal = focal[numbers] if len(focal) > numbers[-1] else focal[:1].repeat(len(numbers), 0)
    known = api.median_calibration(where, (width, height), focal, 1.0)
    return replace(known, camera=known.camera.resized(*size), own=tuple(c.resized(*size) for c in known.own))


def _times_s(where: Path, metadata: dict[str, Any], numbers: list[int]) -> NDArray[np.float64]:
    times = metadata.get("frameTimestamps")
    if isinstance(times, list) and len(times) > numbers[-1]:
        return np.array([api.json_number(where, {"frameTimestamps": times[n]}, "frameTimestamps") for n in numbers])
    fps = api.json_number(where, metadata, "fps", 60.0) or 60.0
    return np.array(numbers) / api.positive_number(where, {"fps": fps}, "fps")


def _truth(
    where: Path, metadata: dict[str, Any], numbers: list[int], times_s: NDArray[np.float64]
) -> Trajectory | None:
    """Return ARKit's path: an estimate by the phone, not ground truth; the front camera has none."""
    poses = _rows(where, metadata, "poses", 7)
    if poses is None or len(poses) <= numbers[-1] or np.ptp(poses, 0).max() == 0:
        return None
    T = np.stack([api.rigid_transform(f"{where}, pose {n}", poses[n, 4:], poses[n, [3, 0, 1, 2]]) for n in numbers])
    return Trajectory(times_s, T @ api.FLIP_YZ)


def _rows(where: Path, metadata: dict[str, Any], key: str, count: int) -> NDArray[np.float64] | None:
    if not metadata.get(key):
        return None
    try:
        rows = np.array(metadata[key], np.float64)
    except (TypeError, ValueError):
        rows = np.zeros(0)
    if rows.ndim != 2 or rows.shape[1] != count or not np.isfinite(rows).all():
        raise SourceError(f'{where}: field "{key}" is not a list of rows with {count} finite numbers; export it again')
    return rows


def _packed(place: Path) -> Path:
    """Return the only .r3d file of a folder, else the place itself."""
    files = [path for path in place.glob("*.r3d") if path.is_file()]
    return files[0] if len(files) == 1 else place


def _recognises(path: str) -> bool:
    place = _packed(Path(path))
    if place.is_file():
        with suppress(*api.DAMAGED), zipfile.ZipFile(place) as archive:
            return place.suffix.lower() == ".r3d" or any("rgbd/" in name for name in archive.namelist())
        return place.suffix.lower() == ".r3d"
    return any((place / "rgbd").glob("*.depth")) or (
        (place / "metadata.json").is_file() and any((place / "depth").glob("*.exr"))
    )


PLUGIN = api.SourceFormat(
    "Record3D", "a .r3d file, or metadata.json with rgb/ and depth/*.exr", _recognises, open_record3d,
    sensor="lidar-iphone",
)  # fmt: skip
