"""Draw small recordings, and write those of phones, directly or with other libraries."""

import json
import zipfile
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

FRAMES = 4
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Converts camera axes between ours and OpenGL's."""


@dataclass
class Scene:
    """The content of a recording: colours [N, H, W, 3] bytes, depths [N, h, w] mm, poses [N, 4, 4], times [N] s."""

    colors: np.ndarray
    depths_mm: np.ndarray
    poses: np.ndarray
    times_s: np.ndarray


def scene(size: tuple[int, int] = (32, 24), depth_size: tuple[int, int] | None = None, seed: int = 0) -> Scene:
    """Create frames with smooth colour (compressible as video or JPEG) and depth of 1 to 3 m with holes."""
    rng = np.random.default_rng(seed)
    (width, height), (w, h) = size, depth_size or size
    coarse = rng.integers(30, 220, (FRAMES, 3, 4, 3), np.uint8)
    colors = np.stack(
        [np.asarray(Image.fromarray(c).resize((width, height), Image.Resampling.BILINEAR)) for c in coarse]
    )
    depths = rng.integers(1000, 3000, (FRAMES, h, w)).astype(np.uint16)
    depths[:, :2, :3] = 0
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.5, (FRAMES, 3))).as_matrix()
    poses[:, :3, 3] = rng.normal(0, 1, (FRAMES, 3))
    return Scene(colors, depths, poses, 1000.0 + np.arange(FRAMES) / 30.0)


def xyzw(T: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(T[:3, :3]).as_quat()


def encoded(array: np.ndarray, kind: str, **options: Any) -> bytes:
    file = BytesIO()
    Image.fromarray(array).save(file, kind, **options)
    return file.getvalue()


def write_stray(folder: Path, seen: Scene, fx: float = 40.0, per_frame: bool = False) -> Path:
    """Write a Stray Scanner folder; the upper left reading of every frame has confidence 0."""
    import cv2

    for part in ("depth", "confidence"):
        (folder / part).mkdir(parents=True)
    height, width = seen.colors.shape[1:3]
    video = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (width, height))
    assert video.isOpened()
    names = "timestamp, frame, x, y, z, qx, qy, qz, qw" + (", fx, fy, cx, cy" if per_frame else "")
    lines = [names]
    for i, (color, depth, T) in enumerate(zip(seen.colors, seen.depths_mm, seen.poses, strict=True)):
        video.write(np.ascontiguousarray(color[..., ::-1]))
        Image.fromarray(depth).save(folder / f"depth/{i:06d}.png")
        sure = np.full(depth.shape, 2, np.uint8)
        sure[-1, -1], sure[-1, -2] = 0, 1
        Image.fromarray(sure).save(folder / f"confidence/{i:06d}.png")
        values = [*T[:3, 3], *xyzw(T), *([fx + i, fx, width / 2, height / 2] if per_frame else [])]
        lines.append(f"{seen.times_s[i]:.6f}, {i:06d}, " + ", ".join(f"{v:.9f}" for v in values))
    video.release()
    (folder / "odometry.csv").write_text("\n".join(lines))
    (folder / "camera_matrix.csv").write_text(f"{fx}, 0.0, {width / 2}\n0.0, {fx}, {height / 2}\n0.0, 0.0, 1.0")
    return folder


def metadata(seen: Scene, **changes: Any) -> dict[str, Any]:
    """Return Record3D's metadata: K by columns, poses as qx qy qz qw x y z in OpenGL's axes."""
    height, width = seen.colors.shape[1:3]
    poses = seen.poses @ OPENGL
    return {
        "w": width, "h": height, "dw": seen.depths_mm.shape[2], "dh": seen.depths_mm.shape[1], "fps": 30,
        "K": [40.0, 0, 0, 0, 41.0, 0, width / 2 - 1, height / 2, 1],
        "poses": [[*map(float, xyzw(T)), *map(float, T[:3, 3])] for T in poses],
        "frameTimestamps": [float(t) for t in seen.times_s],
    } | changes  # fmt: skip


def r3d_members(seen: Scene, **changes: Any) -> dict[str, bytes]:
    """Return the files of a .r3d: LZFSE of float metres with NaN for no reading, and of confidence."""
    import lzfse

    members = {"metadata": json.dumps(metadata(seen, **changes)).encode()}
    for i, (color, depth) in enumerate(zip(seen.colors, seen.depths_mm, strict=True)):
        metres = (depth / 1000.0).astype(np.float32)
        metres[depth == 0] = np.nan
        sure = np.full(depth.shape, 2, np.uint8)
        sure[-1, -1], sure[-1, -2] = 0, 1
        members[f"rgbd/{i}.jpg"] = encoded(color, "JPEG", quality=97, subsampling=0)
        members[f"rgbd/{i}.depth"] = lzfse.compress(metres.tobytes())
        members[f"rgbd/{i}.conf"] = lzfse.compress(sure.tobytes())
    return members


def write_zip(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def write_exr_export(folder: Path, seen: Scene, **changes: Any) -> Path:
    """Write Record3D's export of colour images and EXR files."""
    import OpenEXR

    for part in ("rgb", "depth"):
        (folder / part).mkdir(parents=True)
    (folder / "metadata.json").write_text(json.dumps(metadata(seen, **changes)))
    for i, (color, depth) in enumerate(zip(seen.colors, seen.depths_mm, strict=True)):
        (folder / f"rgb/{i}.jpg").write_bytes(encoded(color, "JPEG", quality=97, subsampling=0))
        pixels = {"R": (depth / 1000.0).astype(np.float32)}
        OpenEXR.File({"type": OpenEXR.scanlineimage}, pixels).write(str(folder / f"depth/{i}.exr"))
    return folder
