"""Intrinsics that other programs leave beside the images are found and read; nothing else is taken for intrinsics."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sigmasplat.errors import SourceError
from sigmasplat.input.opening import open_source

FOCAL = (31.5, 32.5, 15.25, 11.75)
FX, FY, CX, CY = FOCAL
ROS = f"""image_width: 32
image_height: 24
camera_name: narrow
camera_matrix:
  rows: 3
  cols: 3
  data: [{FX}, 0.000000, {CX}, 0.000000, {FY}, {CY}, 0.000000, 0.000000, 1.000000]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.01, -0.02, 0.001, 0.002, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
OPENCV = f"""%YAML:1.0
---
image_width: 32
image_height: 24
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {FX}, 0., {CX}, 0., {FY}, {CY}, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.01, -0.02, 0.001, 0.002, 0. ]
"""
ORB = f"""%YAML:1.0
# Camera calibration and distortion parameters (OpenCV)
Camera.fx: {FX}
Camera.fy: {FY}
Camera.cx: {CX}
Camera.cy: {CY}
Camera.k1: 0.01
Camera.k2: -0.02
Camera.p1: 0.001
Camera.p2: 0.002
Camera.width: 32
Camera.height: 24
Camera.fps: 30.0
DepthMapFactor: 2000.0
ORBextractor.nFeatures: 1000
"""
ORB3 = f"""%YAML:1.0
Camera.type: "PinHole"
Camera1.fx: {FX}
Camera1.fy: {FY}
Camera1.cx: {CX}
Camera1.cy: {CY}
Camera1.k1: 0.01
Camera1.k2: -0.02
Camera1.p1: 0.001
Camera1.p2: 0.002
Camera.width: 32
RGBD.DepthMapFactor: 2000.0
"""
KALIBR = f"""cam0:
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.02, 0.001, 0.002]
  distortion_model: radtan
  intrinsics: [{FX}, {FY}, {CX}, {CY}]
  resolution: [32, 24]
"""
MATRIX = f"{FX} 0 {CX}\n0 {FY} {CY}\n0 0 1\n"
SUN3D = f"{FX} 0 {CX} 0\n0 {FY} {CY} 0\n0 0 1 0\n0 0 0 1\n"
K_LIST = [FX, 0, CX, 0, FY, CY, 0, 0, 1]
LENS = (0.01, -0.02, 0.001, 0.002, 0.0)
FILES = {
    "camera_info.yaml": (ROS, LENS, None),
    "ost.yaml": (ROS, LENS, None),
    "rgb_camera_info.yml": (ROS, LENS, None),
    "calibration.yaml": (OPENCV, LENS, None),
    "TUM1.yaml": (ORB, LENS, 2000.0),
    "camera.yaml": (ORB3, LENS, 2000.0),
    "calib.yaml": (KALIBR, LENS, None),
    "camera-intrinsics.txt": (MATRIX, None, None),
    "intrinsics.txt": (SUN3D, None, None),
    "cam_K.txt": (MATRIX, None, None),
    "K.csv": (MATRIX.replace(" ", ","), None, None),
    "calib.txt": (f"{FX} {FY} {CX} {CY}\n", None, None),
    "calibration.txt": (f"{FX} {FY} {CX} {CY} 0.01 -0.02 0.001 0.002\n", LENS, None),
    "camera.json": (json.dumps({"fx": FX, "fy": FY, "cx": CX, "cy": CY, "width": 32, "height": 24}), None, None),
    "intrinsics.json": (json.dumps({"K": K_LIST}, indent=1), None, None),
    "focal.txt": (f"{FX}\n", None, None),
    "rgb_intrinsics.json": (json.dumps({"camera_matrix": [K_LIST[:3], K_LIST[3:6], K_LIST[6:]]}), None, None),
}


def written(tmp_path: Path, name: str, text: str) -> Path:
    """Write a folder of one frame of 32×24 pixels, with a file of intrinsics."""
    for part in ("rgb", "depth"):
        (tmp_path / part).mkdir(parents=True)
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)).save(tmp_path / "rgb/0.png")
    Image.fromarray(np.full((24, 32), 1500, np.uint16)).save(tmp_path / "depth/0.png")
    (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.parametrize("name", FILES)
def test_the_usual_files_are_read_and_named(name: str, tmp_path: Path) -> None:
    text, lens, units = FILES[name]
    source = open_source(written(tmp_path, name, text))
    c = source.camera
    assert (c.fx, c.fy, c.cx, c.cy) == pytest.approx((FX, FX, 15.5, 11.5) if name == "focal.txt" else FOCAL)
    assert source.origins["camera"].origin == f"read from {tmp_path / name}"
    assert source.depth_units_per_metre == (units or 1000.0)
    assert (source.origins["depth unit"].origin == "assumed") == (units is None)
    assert any(line.startswith("lens: no distortion") for line in source.assumptions) == (lens is None)


def test_intrinsics_of_larger_images_are_scaled(tmp_path: Path) -> None:
    text = json.dumps({"fx": 2 * FX, "fy": 2 * FY, "cx": 2 * CX + 0.5, "cy": 2 * CY + 0.5, "width": 64, "height": 48})
    c = open_source(written(tmp_path, "camera.json", text)).camera
    assert (c.fx, c.fy, c.cx, c.cy) == pytest.approx(FOCAL)


def test_a_given_focal_length_and_a_calibration_json_come_first(tmp_path: Path) -> None:
    folder = written(tmp_path, "camera_info.yaml", ROS)
    given = open_source(folder, fx=40.0)
    assert given.camera.fx == 40.0 and given.origins["camera"].origin == "given"
    (folder / "calibration.json").write_text('{"fx": 50, "fy": 50, "cx": 15, "cy": 12}')
    assert open_source(folder).camera.fx == 50.0


def test_the_lens_of_another_file_does_not_join_the_camera_of_a_calibration_json(tmp_path: Path) -> None:
    folder = written(tmp_path / "a", "camera_info.yaml", ROS)
    camera = '{"fx": 50, "fy": 50, "cx": 15, "cy": 12}'
    (tmp_path / "own.json").write_text(camera)
    given = open_source(folder, calibration=str(tmp_path / "own.json"))
    (folder / "calibration.json").write_text(camera)
    for source in (given, open_source(folder)):
        assert any(line.startswith("lens: no distortion") for line in source.assumptions)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("camera.txt", "moved at 12:30, 4 lights\n"),
        ("camera.json", '{"model": "D435", "serial": 12345678, "fps": 30}'),
        ("calib.txt", "1 2 3\n"),
        ("camera_path.txt", f"{FX} {FY} {CX} {CY}\n"),
        ("poses.txt", MATRIX),
        ("K.txt", "0 0 0\n0 0 0\n0 0 1\n"),
    ],
)
def test_other_files_are_not_taken_for_intrinsics(name: str, text: str, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="camera unknown"):
        open_source(written(tmp_path, name, text))
