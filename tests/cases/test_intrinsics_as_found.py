"""Intrinsics as a dozen programs write them, in files of any name; what else they say: the unit of depth, the lens, the
size of the images they are for."""

import json
from pathlib import Path

import numpy as np
import pytest

import layouts
from sigmasplat.errors import SourceError
from sigmasplat.input.opening import open_source

FOCAL = (31.5, 32.5, 15.25, 11.75)
FX, FY, CX, CY = FOCAL
K = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
FLAT = [value for row in K for value in row]
REALSENSE = {"width": 32, "height": 24, "ppx": CX, "ppy": CY, "fx": FX, "fy": FY, "model": "Brown Conrady"}
DEPTH = {"width": 848, "height": 480, "ppx": 422.6, "ppy": 241.4, "fx": 426.3, "fy": 426.3}
FILES = {
    "RealSense": ("intrinsics.json", REALSENSE | {"coeffs": [0.0] * 5, "depth_scale": 0.001}, 1000.0),
    "two cameras": ("intrinsics.json", {"depth": DEPTH, "color": REALSENSE, "depth_scale": 9.999999747e-05}, 10_000),
    "two cameras, nested": ("camera.json", {"depth": {"K": DEPTH}, "rgb": {"K": REALSENSE}}, None),
    "BOP": ("scene_camera.json", {str(i): {"cam_K": FLAT, "depth_scale": 0.1} for i in range(900)}, 10_000.0),
    "BOP, camera": ("camera.json", {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "depth_scale": 1.0}, 1000.0),
    "any name": ("D435i_640.yaml", f"Camera.fx: {FX}\nCamera.fy: {FY}\nCamera.cx: {CX}\nCamera.cy: {CY}\n", None),
    "YAML of two": (
        "cameras.yaml", f"depth:\n  fx: 1\n  fy: 2\ncolor:\n  fx: {FX}\n  fy: {FY}\n  cx: {CX}\n  cy: {CY}\n", None,
    ),
    "Spectacular AI": (
        "calibration.json",
        {"cameras": [{"focalLengthX": FX, "focalLengthY": FY, "principalPointX": CX, "principalPointY": CY}]}, None,
    ),
    "OpenCV": ("calibration.json", {"camera_matrix": K, "dist_coeff": [[0.0, 0.0, 0.0, 0.0, 0.0]]}, None),
    "Open3D": ("intrinsic_o3d.json", {"intrinsic_matrix": np.array(K).T.ravel().tolist(), "depth_scale": 1e3}, 1000.0),
    "every frame": ("pose_intrinsic_imu.json", {f"{i}": {"intrinsic": K, "imu": [0] * 99} for i in range(900)}, None),
}  # fmt: skip


def written(folder: Path, name: str, content: object) -> Path:
    """Write a folder of one frame of 32×24 pixels, with a file of intrinsics."""
    layouts.save(folder / "rgb/0.png", np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8))
    layouts.save(folder / "depth/0.png", np.full((24, 32), 1500, np.uint16))
    layouts.save_text(folder / name, content if isinstance(content, str) else json.dumps(content))
    return folder


@pytest.mark.parametrize("kind", FILES)
def test_files_of_a_dozen_programs_are_read(tmp_path: Path, kind: str) -> None:
    name, content, units = FILES[kind]
    source = open_source(written(tmp_path, name, content))
    c = source.camera
    assert (c.fx, c.fy, c.cx, c.cy) == pytest.approx(FOCAL)
    assert source.origins["camera"].origin == f"read from {tmp_path / name}"
    assert source.depth_units_per_metre == pytest.approx(units or 1000.0)
    assert (source.origins["depth unit"].origin == "assumed") == (units is None)


def test_the_lens_of_opencv_s_python_is_not_lost(tmp_path: Path) -> None:
    content = {"camera_matrix": K, "dist_coeff": [[0.1, 0.0, 0.0, 0.0, 0.0]]}
    assert "lens" not in open_source(written(tmp_path, "calibration.json", content)).origins


@pytest.mark.parametrize("times", [0.5, 2, 3])
def test_intrinsics_of_another_size_are_known_by_their_image_centre(tmp_path: Path, times: float) -> None:
    fx, fy = FX * times, FY * times
    cx, cy = (CX + 0.5) * times - 0.5, (CY + 0.5) * times - 0.5
    source = open_source(written(tmp_path, "intrinsics.txt", f"{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n"))
    assert (source.camera.fx, source.camera.cx) == pytest.approx((FX, CX))
    value, origin, _ = source.origins["size of the calibration"]
    assert value == f"{32 * times:g}×{24 * times:g}, which has the nearest centre" and origin == "measured"


def test_scannet_s_colour_camera_beside_images_of_its_depth_s_size(tmp_path: Path) -> None:
    layouts.save(tmp_path / "rgb/0.png", np.full((480, 640, 3), 99, np.uint8))
    layouts.save(tmp_path / "depth/0.png", np.full((480, 640), 1500, np.uint16))
    layouts.save_text(tmp_path / "intrinsics.txt", "1169.6 0 646.3 0\n0 1167.1 489.9 0\n0 0 1 0\n0 0 0 1\n")
    c = open_source(tmp_path).camera
    assert (c.fx, c.fy) == pytest.approx((1169.6 * 640 / 1296, 1167.1 * 480 / 968))


@pytest.mark.parametrize("content", [{"CalibrationInformation": {"Cameras": [{"Rt": [1, 0]}]}}, {"cameras": []}])
def test_a_calibration_json_of_another_program_without_a_camera_asks_for_one(tmp_path: Path, content: object) -> None:
    with pytest.raises(SourceError, match=r"camera unknown: .*--fx PIXELS"):
        open_source(written(tmp_path, "calibration.json", content))
    assert open_source(tmp_path, fx=30.0).camera.fx == 30.0


def test_intrinsics_beside_files_named_as_those_of_7_scenes(tmp_path: Path) -> None:
    seen = layouts.sample()
    for n in range(layouts.FRAMES):
        layouts.save(tmp_path / f"frame-{n:06d}.color.png", seen.color[n])
        layouts.save(tmp_path / f"frame-{n:06d}.depth.png", seen.depth_mm[n])
    layouts.save_text(tmp_path / "camera-intrinsics.txt", "\n".join(" ".join(map(str, row)) for row in K))
    assert open_source(tmp_path).camera.fx == FX
