"""Paths in other programs' formats, checked by independent readers; COLMAP's also by its own reader."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sigmasplat.data.camera import Camera
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.plugins.outputs import colmap

CAMERA = Camera(64, 48, 50.0, 51.0, 30.25, 24.75)
NAMES = [f"frame-{i:06d}.png" for i in range(7)]


def some_path(n: int = 7) -> Trajectory:
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = Rotation.random(n, random_state=2).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(2).normal(0, 3, (n, 3))
    return Trajectory(100.0 + np.arange(n) / 30.0, poses)


def seen_by_colmap(points: np.ndarray, line: list[str], camera: list[str]) -> np.ndarray:
    """Project points as COLMAP documents it: R, t to the camera, PINHOLE, the first pixel's centre at (½, ½)."""
    w, x, y, z, *t = (float(word) for word in line[1:8])
    fx, fy, cx, cy = (float(word) for word in camera[4:])
    p = Rotation.from_quat([x, y, z, w]).apply(points) + t
    return np.stack([fx * p[:, 0] / p[:, 2] + cx, fy * p[:, 1] / p[:, 2] + cy], 1)


def seen_by_us(points: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    p = (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    return np.stack([CAMERA.fx * p[:, 0] / p[:, 2] + CAMERA.cx, CAMERA.fy * p[:, 1] / p[:, 2] + CAMERA.cy], 1)


def ahead(T_world_camera: np.ndarray) -> np.ndarray:
    """Return points in front of a camera, in the world frame."""
    points = np.random.default_rng(3).uniform([-1, -1, 1], [1, 1, 4], (20, 3))
    return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def write_colmap(folder: Path) -> tuple[Trajectory, np.ndarray, np.ndarray]:
    path, rng = some_path(), np.random.default_rng(4)
    points, colors = rng.normal(size=(30, 3)), rng.uniform(-0.1, 1.1, (30, 3))
    colmap.write_model(folder, CAMERA, NAMES, path.T_world_camera, points, colors)
    return path, points, colors


def test_colmap_text_has_the_documented_layout(tmp_path: Path) -> None:
    path, points, colors = write_colmap(tmp_path)
    lines = {
        name: [line for line in (tmp_path / f"{name}.txt").read_text().split("\n") if not line.startswith("#")]
        for name in ("cameras", "images", "points3D")
    }
    (camera, end), images = lines["cameras"], lines["images"]
    assert camera.split()[:4] == ["1", "PINHOLE", "64", "48"] and end == ""
    assert images[1:-1:2] == [""] * 7, "an empty line of features after each image"
    for i, (line, T) in enumerate(zip(images[:-1:2], path.T_world_camera, strict=True)):
        words, there = line.split(), ahead(T)
        assert (words[0], words[8], words[9]) == (str(i + 1), "1", NAMES[i]) and len(words) == 10
        np.testing.assert_allclose(seen_by_colmap(there, words, camera.split()) - 0.5, seen_by_us(there, T), atol=1e-6)
    rows = np.array([line.split() for line in lines["points3D"][:-1]], float)
    np.testing.assert_allclose(rows[:, 1:4], points, atol=1e-6)
    np.testing.assert_array_equal(rows[:, 4:7], np.rint(np.clip(colors, 0, 1) * 255))
    assert rows.shape == (30, 8) and rows[:, 0].tolist() == list(range(1, 31)), "no tracks"


def test_colmap_reads_it(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="COLMAP's own reader is 38 MB: pip install pycolmap")
    path, points, colors = write_colmap(tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert (len(model.cameras), len(model.images), len(model.points3D)) == (1, 7, 30)
    for image in model.images.values():
        T = path.T_world_camera[NAMES.index(image.name)]
        there = ahead(T)
        pixels = np.array([image.project_point(point) for point in there])
        np.testing.assert_allclose(pixels - 0.5, seen_by_us(there, T), atol=1e-6)
    for number, point in model.points3D.items():
        np.testing.assert_allclose(point.xyz, points[number - 1], atol=1e-6)
        np.testing.assert_array_equal(point.color, np.rint(np.clip(colors[number - 1], 0, 1) * 255))
