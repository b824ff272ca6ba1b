"""Depth of a separate camera, registered to the colour camera."""

import json

import numpy as np
import pytest
from PIL import Image

from sigmasplat.data.camera import Camera
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.input.rectification import MAX_HALF_FOOTPRINT_PX, OVERLAP, DepthRegistration
from sigmasplat.plugins.sources import open_source

DEPTH = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
COLOR = Camera(80, 60, 70.0, 72.0, 40.0, 29.0)


def shifted(x_m: float, y_m: float = 0.0, degrees: float = 0.0) -> np.ndarray:
    T, angle = np.eye(4), np.radians(degrees)
    T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T[:3, 3] = x_m, y_m, 0.0
    return T


def plane_depth(camera: Camera, T_plane_camera: np.ndarray, normal: np.ndarray, distance_m: float) -> np.ndarray:
    """Return exact depth [H, W] of the plane normal·p = distance, given in another camera's frame."""
    rays = camera.rays().astype(np.float64) @ T_plane_camera[:3, :3].T
    return (distance_m - normal @ T_plane_camera[:3, 3]) / (rays @ normal)


def test_the_same_camera_changes_nothing():
    depth = np.random.default_rng(0).uniform(1, 3, (48, 64)).astype(np.float32)
    depth[10:20, 5:9] = 0
    moved = DepthRegistration(DEPTH, DEPTH, np.eye(4))(depth)
    nearest = np.minimum.reduce([depth])
    assert np.array_equal(moved, nearest)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, -0.2, 0.93)])
def test_a_registered_plane_stays_in_place(normal):
    T_color_depth, n = shifted(0.05, 0.02, 3.0), np.array(normal)
    measured = plane_depth(DEPTH, np.eye(4), n, 2.0).astype(np.float32)
    moved = DepthRegistration(DEPTH, COLOR, T_color_depth)(measured)
    exact = plane_depth(COLOR, np.linalg.inv(T_color_depth), n, 2.0)
    seen = moved > 0
    assert seen[8:-8, 12:-12].all(), "no gaps inside"
    slope_m = 2.0 / 60.0  # half a depth pixel on a plane tilted by up to 45°
    assert np.abs(moved - exact)[seen].max() < slope_m


def test_the_nearer_surface_hides_the_farther_one():
    depth = np.full((48, 64), 4.0, np.float32)
    depth[:, 20:40] = 1.0
    moved = DepthRegistration(DEPTH, DEPTH, shifted(-0.1))(depth)  # the near wall moves by 6 px, the far one by 1.5
    row = moved[24]
    assert (row[14:34] == 1.0).all(), "no hidden surface is visible"
    assert (row[:13] == 4.0).all() and (row[40:61] == 4.0).all()
    assert (row[35:38] == 0.0).all(), "surfaces hidden from the depth camera have no depth"


def by_definition(depth_camera: Camera, color: Camera, T: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Draw the readings one by one, pixel by pixel."""
    drawn = np.full((color.height, color.width), np.inf)
    rays = depth_camera.rays().reshape(-1, 3).astype(np.float64) @ T[:3, :3].T
    for ray, reading in zip(rays, depth.reshape(-1), strict=True):
        x, y, z = ray * reading + T[:3, 3]
        if reading <= 0 or z <= 1e-6:
            continue
        size = OVERLAP * reading / z
        u, v = color.fx * x / z + color.cx, color.fy * y / z + color.cy
        half_u = min(0.5 * size * color.fx / depth_camera.fx, MAX_HALF_FOOTPRINT_PX)
        half_v = min(0.5 * size * color.fy / depth_camera.fy, MAX_HALF_FOOTPRINT_PX)
        columns = [c for c in range(color.width) if u - half_u <= c <= u + half_u]
        for r in range(color.height):
            for c in columns if v - half_v <= r <= v + half_v else ():
                drawn[r, c] = min(drawn[r, c], z)
    return np.where(np.isinf(drawn), 0, drawn).astype(np.float32)


@pytest.mark.parametrize(
    ("depth_camera", "T_color_depth"),
    [
        (DEPTH, shifted(0.05, 0.02, 3.0)),
        (Camera(120, 90, 110.0, 112.0, 60.0, 44.0), shifted(-0.03, 0.01, -2.0)),  # larger than colour
        (Camera(12, 9, 10.0, 11.0, 6.0, 4.0), shifted(0.0, 0.1, 10.0)),  # smaller: squares of 8 px and more
        (DEPTH, shifted(0.0, 0.0, 178.0)),  # looks backwards: some points are at the camera
    ],
)
def test_registered_depth_equals_the_definition_bit_for_bit(depth_camera, T_color_depth):
    random = np.random.default_rng(1)
    depth = random.uniform(0.3, 4.0, (depth_camera.height, depth_camera.width)).astype(np.float32)
    depth[random.random(depth.shape) < 0.2] = 0
    T_color_depth[2, 3] += 0.4
    moved = DepthRegistration(depth_camera, COLOR, T_color_depth)(depth)
    assert moved.any() and moved.tobytes() == by_definition(depth_camera, COLOR, T_color_depth, depth).tobytes()


def test_missing_readings_and_points_behind_the_camera_give_no_depth():
    back = np.diag([1.0, 1.0, 1.0, 1.0])
    back[2, 3] = -3.0
    assert not DepthRegistration(DEPTH, COLOR, np.eye(4))(np.zeros((48, 64), np.float32)).any()
    assert not DepthRegistration(DEPTH, COLOR, back)(np.full((48, 64), 2.0, np.float32)).any()


def with_depth_camera(folder, **changes):
    fields = json.loads((folder / "calibration.json").read_text())
    fields["depth_camera"] = {"fx": 15.0, "fy": 15.0, "cx": 7.5, "cy": 5.5, "width": 16, "height": 12}
    fields["T_color_depth"] = np.eye(4).tolist()
    (folder / "calibration.json").write_text(json.dumps(fields | changes))
    for i in range(4):
        Image.fromarray(np.full((12, 16), 2000, np.uint16)).save(folder / f"depth/{i}.png")


def test_a_depth_camera_in_the_calibration_registers_at_the_width_of_depth(tiny_tum):
    with_depth_camera(tiny_tum)
    source = open_source(tiny_tum)
    assert source.depth_registered and (source.camera.width, source.camera.height) == (16, 12)
    frame = source.frame(0)
    assert frame.color.shape == (12, 16, 3) and (frame.depth_m[1:-1, 1:-1] == 2.0).all()


def test_registration_can_be_switched_off_and_on(tiny_tum):
    with pytest.raises(SourceError, match="depth camera is unknown; give depth_camera"):
        open_source(tiny_tum, register_depth="on")
    with_depth_camera(tiny_tum)
    with pytest.raises(SourceError, match="register depth to colour"):
        open_source(tiny_tum, register_depth="off")


@pytest.mark.parametrize("matrix", [[[1, 2], [3, 4]], np.diag([2.0, 1, 1, 1]).tolist(), "none", [[1, "x"]]])
def test_an_invalid_transform_is_refused(tiny_tum, matrix):
    with_depth_camera(tiny_tum, T_color_depth=matrix)
    with pytest.raises(SourceError, match=r"calibration.json: field \"T_color_depth\" is not a rigid 4×4"):
        open_source(tiny_tum)


def test_settings_override_the_recording(tiny_tum, tmp_path):
    source = open_source(tiny_tum, fx=40.0, cx=16.0, depth_scale=500.0)
    assert (source.camera.fx, source.camera.fy, source.camera.cx, source.camera.cy) == (40.0, 30.0, 16.0, 11.5)
    assert (source.frame(0).depth_m == 4.0).all()
    other = tmp_path / "other.json"
    other.write_text(json.dumps({"fx": 20, "fy": 21, "cx": 15, "cy": 11}))
    assert open_source(tiny_tum, calibration=str(other)).camera.fy == 21.0


def test_a_focal_length_is_enough_without_calibration(tiny_tum):
    (tiny_tum / "calibration.json").unlink()
    with pytest.raises(SourceError, match=r"camera unknown: .* or give --fx"):
        open_source(tiny_tum)
    camera = open_source(tiny_tum, fx=33.0, depth_scale=1000.0).camera
    assert (camera.fy, camera.cx, camera.cy) == (33.0, 15.5, 11.5)


def test_a_misspelt_setting_suggests_the_closest_name(tiny_tum):
    with pytest.raises(ConfigError, match="did you mean stride"):
        open_source(tiny_tum, strid=2)
