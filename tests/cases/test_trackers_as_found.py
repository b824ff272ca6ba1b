"""BundleFusion's recordings, COLMAP's cameras, TartanAir's depth and poses, and what Polycam did not complete."""

import json
from pathlib import Path

import numpy as np

import layouts
from layouts import FRAMES, LARGE, SMALL_CAMERA, rows, sample
from sigmasplat.input.opening import format_of, open_source


def test_bundlefusion_has_its_camera_in_one_file(tmp_path: Path) -> None:
    seen = sample()
    for n in range(FRAMES):
        layouts.save(tmp_path / f"frame-{n:06d}.color.png", seen.color[n].repeat(2, 0).repeat(2, 1))
        layouts.save(tmp_path / f"frame-{n:06d}.depth.png", seen.depth_mm[n] * 2)
        layouts.save_text(tmp_path / f"frame-{n:06d}.pose.txt", rows(seen.T_world_camera[n]))
    matrix = " ".join(f"{value:g}" for value in layouts.intrinsic(LARGE).ravel())
    unit = " ".join(f"{value:g}" for value in np.eye(4).ravel())
    layouts.save_text(
        tmp_path / "info.txt",
        "m_versionNumber = 4\nm_sensorName = StructureSensor\nm_colorWidth = 64\nm_colorHeight = 48\nm_depthWidth = 32"
        f"\nm_depthHeight = 24\nm_depthShift = 2000\nm_calibrationColorIntrinsic = {matrix} \n"
        f"m_calibrationColorExtrinsic = {unit} \nm_calibrationDepthIntrinsic = {matrix} \n",
    )
    source = open_source(tmp_path)
    assert format_of(tmp_path).name == "BundleFusion" and source.path_by == "the device"
    assert (source.camera.fx, source.depth_units_per_metre) == (SMALL_CAMERA.fx, 2000.0)
    assert source.frame(1).depth_m[12, 16] == np.float32(seen.depth_mm[1, 12, 16] / 1000)


def plain(folder: Path) -> Path:
    seen = sample()
    for n in range(FRAMES):
        layouts.save(folder / f"image_left/{n:06d}_left.png", seen.color[n])
        layouts.save(folder / f"depth_left/{n:06d}_left_depth.png", seen.depth_mm[n])
    return folder


def test_a_camera_of_colmap_has_its_pixels_half_a_pixel_off(tmp_path: Path) -> None:
    text = "# Camera list\n1 OPENCV 64 48 60 62 31 24.5 0.01 0 0 0\n"
    layouts.save_text(plain(tmp_path) / "sparse/0/cameras.txt", text)
    source = open_source(tmp_path)
    assert (source.camera.fx, source.camera.cx) == (30.0, 15.0) and "lens" not in source.origins
    layouts.save_text(tmp_path / "sparse/0/cameras.txt", "1 SIMPLE_PINHOLE 32 24 30 16 12\n")
    assert open_source(tmp_path).camera == layouts.Camera(32, 24, 30.0, 30.0, 15.5, 11.5)


def test_tartanair_stores_floats_as_colours_and_poses_with_x_forward(tmp_path: Path) -> None:
    seen, T_ned_camera = sample(), np.eye(4)[[2, 0, 1, 3]]
    for n in range(FRAMES):
        layouts.save(tmp_path / f"image_lcam_front/{n}.png", seen.color[n])
        floats = (seen.depth_mm[n] / 1000).astype("<f4").view(np.uint8).reshape(24, 32, 4)
        layouts.save(tmp_path / f"depth_lcam_front/{n}.png", floats[..., [2, 1, 0, 3]])
    lines = [layouts.tum_line(0, T @ np.linalg.inv(T_ned_camera)).split(" ", 1)[1] for T in seen.T_world_camera]
    for name in ("pose_lcam_front.txt", "mine.txt"):
        (tmp_path / name).write_text("".join(lines))
    source = open_source(tmp_path, fx=30.0, poses=str(tmp_path / "pose_lcam_front.txt"))
    assert np.allclose(source.frame(2).depth_m, seen.depth_mm[2] / np.float32(1000))
    np.testing.assert_allclose(source.frame(2).T_given_camera, seen.T_world_camera[2], atol=1e-6)
    own = open_source(tmp_path, fx=30.0, poses=str(tmp_path / "mine.txt")).frame(2).T_given_camera
    np.testing.assert_allclose(own @ T_ned_camera, seen.T_world_camera[2], atol=1e-6)


def test_images_that_polycam_did_not_correct_are_listed(tmp_path: Path) -> None:
    seen = sample()
    for kind, count in (("", FRAMES), ("corrected_", 2)):
        for n in range(count):
            layouts.save(tmp_path / f"keyframes/{kind}images/{5603927833 + n}.jpg", seen.color[n])
            layouts.save(tmp_path / f"keyframes/depth/{5603927833 + n}.png", seen.depth_mm[n])
            fields = {f"t_{i}{j}": float(i == j) for i in range(3) for j in range(4)}
            fields |= {"fx": 30, "fy": 30, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24}
            layouts.save_text(tmp_path / f"keyframes/{kind}cameras/{5603927833 + n}.json", json.dumps(fields))
    source = open_source(tmp_path)
    assert len(source) == 2 and [text.split(": ")[1] for text in source.skipped] == ["not in corrected_cameras"] * 2
