"""The surface that users get: closed where something was seen, within a budget of triangles, right side up."""

from collections.abc import Iterator

import numpy as np
import pytest

from box_room import CAMERA, CHEST, HIGH, LOW, PILLAR, cast, pose, seer, splats
from sigmasplat.config import SurfaceConfig
from sigmasplat.data import se3
from sigmasplat.data.mesh import Mesh, mesh_depth
from sigmasplat.data.submap import Picture
from sigmasplat.errors import ConfigError
from sigmasplat.final.fusion import FusionView, fuse, with_readings
from sigmasplat.plugins.outputs.mesh_editing import decimated
from sigmasplat.plugins.presets.shared_by_papers import BASE

VOXEL_M = 0.04


def standpoints() -> list[np.ndarray]:
    """Return T_room_camera of views that together see the floor and the lower walls of the room of `box_room`."""
    yaws = 2 * np.pi * np.arange(16) / 16
    return [pose((0.3 * np.cos(yaw), 0.3 * np.sin(yaw), 1.5), yaw, pitch) for yaw in yaws for pitch in (-0.9, -0.2)]


def true_depth(T: np.ndarray) -> np.ndarray:
    return cast(T[:3, 3], CAMERA.rays().astype(float) @ T[:3, :3].T, [PILLAR, CHEST]).astype(np.float32)


def readings(rng: np.random.Generator, noise_m: float = 0.0) -> Iterator[FusionView]:
    """Yield the views with a picture that lacks a third of the readings."""
    field = splats(np.eye(4))
    for T in standpoints():
        depth_m = true_depth(T)
        depth_m += (noise_m * rng.standard_normal(depth_m.shape)).astype(np.float32)
        depth_m[rng.random(depth_m.shape) < 1 / 3] = 0.0
        picture = Picture(np.full((*depth_m.shape, 3), 128, np.uint8), depth_m)
        yield FusionView(field, CAMERA, se3.inverse(T), T, picture)


def coverage(mesh: Mesh) -> tuple[float, float]:
    """Return the share of the pixels between the views that show the mesh, and their mean error of depth, m."""
    shares, errors = [], []
    for T in standpoints()[::5]:
        between = T @ se3.exp(np.array([0.1, 0.0, 0.1, 0.0, 0.1, 0.0]))
        truth = true_depth(between)
        depth_m, _ = mesh_depth(mesh, CAMERA, se3.inverse(between))
        seen = np.zeros(truth.shape, bool)
        seen[20:-20, 20:-20] = True
        shares.append((depth_m[seen] > 0).mean())
        errors.append(np.abs(depth_m - truth)[seen & (depth_m > 0)].mean())
    return float(np.mean(shares)), float(np.mean(errors))


@pytest.mark.parametrize("with_pictures", [False, True])
def test_a_room_is_closed_where_it_was_seen(with_pictures: bool) -> None:
    views = list(readings(np.random.default_rng(0)))
    if not with_pictures:
        views = [FusionView(v.field, v.camera, v.T_camera_field, v.T_world_camera) for v in views]
    mesh = fuse(views, len(views), BASE, voxel_m=VOXEL_M, renderer=seer(np.eye(4)))
    share, error_m = coverage(mesh)
    assert share > 0.998 and error_m < 0.01
    inside = (mesh.vertices > LOW - VOXEL_M) & (mesh.vertices < HIGH + VOXEL_M)
    assert inside.all(), "no floaters outside the room"


def test_a_reading_corrects_a_map_that_is_off() -> None:
    """The renderer of a room without its chest stands for a wrong map: the readings see the chest."""
    views = list(readings(np.random.default_rng(1), noise_m=0.005))
    wrong = seer(np.eye(4), boxes=(PILLAR,))
    mesh = fuse(views, len(views), BASE, voxel_m=VOXEL_M, renderer=wrong)
    top = CHEST[1][2]
    above = (np.abs(mesh.vertices[:, 2] - top) < 0.02) & (mesh.vertices[:, 0] < CHEST[1][0] - VOXEL_M)
    assert above.sum() > 30


def test_render_and_reading_share_a_pixel_and_close_each_others_holes() -> None:
    rendered = np.full((6, 8), 2.0, np.float32)
    rendered[:, 6:] = 3.0
    reading = np.full((6, 8), 2.02, np.float32)
    reading[0], reading[1] = 0.0, 2.5
    picture = Picture(np.full((6, 8, 3), 255, np.uint8), reading)
    depth_m, color, weight = with_readings(rendered, np.zeros((6, 8, 3), np.float32), picture)
    np.testing.assert_allclose(depth_m[0, :5], 2.0, err_msg="without a reading, the render")
    assert not weight[0, 5:7].any(), "without a reading, a silhouette of the render has no depth"
    np.testing.assert_allclose(depth_m[1], 2.5, err_msg="where they disagree, the reading")
    assert ((depth_m[2:, :5] > 2.0) & (depth_m[2:, :5] < 2.02)).all() and (weight[2:, :5] > weight[1, :5]).all()
    assert not color[0].any() and (color[1:] == 1.0).all()


def bumpy(edge: int = 60) -> Mesh:
    """Return a sheet of 2 × edge² triangles, gently curved, red on one half."""
    x, y = np.meshgrid(np.linspace(0, 1, edge + 1), np.linspace(0, 1, edge + 1), indexing="ij")
    vertices = np.stack([x, y, 0.05 * np.sin(4 * x) * np.cos(3 * y)], -1).reshape(-1, 3).astype(np.float32)
    at = np.arange((edge + 1) ** 2).reshape(edge + 1, edge + 1)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    red = np.where(vertices[:, :1] < 0.5, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]).astype(np.float32)
    return Mesh(vertices, faces, red, vertices[:, 0].copy())


def test_decimation_keeps_the_budget_the_surface_and_the_colours() -> None:
    pytest.importorskip("fast_simplification", reason="needs fast-simplification, a dependency of the package")
    whole = bumpy()
    small = decimated(whole, 600)
    assert 400 < len(small.faces) <= 600
    assert small.areas().sum() == pytest.approx(whole.areas().sum(), rel=0.01)
    x, y, z = small.vertices.T
    np.testing.assert_allclose(z, 0.05 * np.sin(4 * x) * np.cos(3 * y), atol=2e-3)
    away = np.abs(x - 0.5) > 0.1
    np.testing.assert_allclose(small.colors[away], np.where(x[away, None] < 0.5, [[1, 0, 0]], [[0, 0, 1]]), atol=1e-6)
    np.testing.assert_allclose(small.depth_std_m, x, atol=0.05)
    again = decimated(whole, 600)
    np.testing.assert_array_equal(small.vertices, again.vertices)
    np.testing.assert_array_equal(small.faces, again.faces)


def test_small_meshes_and_budgets_without_a_limit_change_nothing() -> None:
    mesh = bumpy(4)
    assert decimated(mesh, len(mesh.faces)) is mesh and decimated(mesh, 0) is mesh
    assert decimated(mesh, -1) is mesh


def test_floaters_are_small_relative_to_the_surface() -> None:
    sheet = bumpy(40)
    floater = Mesh((0.01 * sheet.vertices + [0, 0, 1]).astype(np.float32), sheet.faces)
    both = Mesh.concatenated([Mesh(sheet.vertices, sheet.faces), floater])
    assert len(both.without_small_parts(200).faces) == 2 * len(sheet.faces), "both have many vertices"
    assert len(both.without_small_parts(200, share=0.001).faces) == len(sheet.faces)


def test_an_unknown_kind_of_depth_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"surface\.depth must be"):
        SurfaceConfig(depth="sensor")  # type: ignore[arg-type]
