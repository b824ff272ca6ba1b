"""The fused surface: where analytic depth says it is, closed, without seams, and only where something was seen."""

from collections.abc import Callable, Iterator
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.mesh import Mesh
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.final.tsdf import Tsdf, extract_surface, packed, unpacked

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
VOXEL_M = 0.01
CENTER, RADIUS_M = np.array([0.013, 0.021, -0.007]), 0.2


def looking(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return T_world_camera [4, 4] of a camera at `eye` that looks at `target`, z up."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = right, np.cross(forward, right), forward, eye
    return T


def rays(T: np.ndarray) -> np.ndarray:
    return CAMERA.rays().astype(float) @ T[:3, :3].T


def sphere_depth(T: np.ndarray, radius_m: float = RADIUS_M, center: np.ndarray = CENTER) -> np.ndarray:
    d, o = rays(T), T[:3, 3] - center
    a, b, c = (d * d).sum(-1), (d * o).sum(-1), o @ o - radius_m**2
    inside = b * b - a * c
    return np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0.0))) / a, 0.0).astype(np.float32)


def floor_depth(T: np.ndarray, farthest_m: float = 4.0) -> np.ndarray:
    down = np.minimum(rays(T)[..., 2], -1e-6)
    depth = -T[2, 3] / down
    return np.where(depth < farthest_m, depth, 0.0).astype(np.float32)


def all_around(views: int = 24) -> Iterator[np.ndarray]:
    for k in range(views):
        height, turn = 1 - 2 * (k + 0.5) / views, 2.399963 * k
        level = np.sqrt(1 - height**2)
        yield looking(CENTER + 0.8 * np.array([level * np.cos(turn), level * np.sin(turn), height]), CENTER)


def gray(depth: np.ndarray) -> np.ndarray:
    return np.full((*depth.shape, 3), 0.5, np.float32)


def fused(poses: list[np.ndarray], depth_of: Callable[[np.ndarray], np.ndarray]) -> Mesh:
    volume = Tsdf(VOXEL_M, 4 * VOXEL_M)
    for T in poses:
        volume.integrate(depth_of(T), gray(depth_of(T)), CAMERA, T)
    return extract_surface(volume)


@cache
def sphere() -> Mesh:
    return fused(list(all_around()), sphere_depth)


def edges(mesh: Mesh) -> tuple[int, np.ndarray]:
    """Return the number of edges, and how many faces share each."""
    pairs = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, shared = np.unique(pairs, axis=0, return_counts=True)
    return len(shared), shared


def volume_m3(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def test_a_sphere_is_there_within_half_a_voxel_and_faces_outwards() -> None:
    off = np.linalg.norm(sphere().vertices - CENTER, axis=1) - RADIUS_M
    assert len(off) > 5000 and np.abs(off).max() < VOXEL_M / 2 and np.abs(off).mean() < VOXEL_M / 8
    assert volume_m3(sphere()) == pytest.approx(4 / 3 * np.pi * RADIUS_M**3, rel=0.03)


def test_the_sphere_is_closed_across_the_seams_of_its_bricks() -> None:
    """Its centre is near a corner of eight bricks, each cut by itself."""
    count, shared = edges(sphere())
    assert (shared == 2).all(), "no edge is open and none belongs to three faces"
    assert len(sphere().vertices) - count + len(sphere().faces) == 2, "Euler"
    assert len(np.unique(sphere().vertices, axis=0)) == len(sphere().vertices), "welded"


def test_the_same_images_make_the_same_bytes() -> None:
    again = fused(list(all_around()), sphere_depth)
    for name in ("vertices", "faces", "colors"):
        assert getattr(again, name).tobytes() == getattr(sphere(), name).tobytes()


def test_moving_world_and_cameras_by_whole_voxels_moves_the_surface() -> None:
    shift = np.array([7, -13, 66]) * VOXEL_M
    moved = fused(
        [se3.exp(np.r_[shift, 0, 0, 0]) @ T for T in all_around()], lambda T: sphere_depth(T, center=CENTER + shift)
    )
    assert len(moved.vertices) == pytest.approx(len(sphere().vertices), rel=2e-3)
    off = cKDTree(sphere().vertices).query(moved.vertices - shift)[0]
    assert np.quantile(off, 0.99) < 1e-4 * VOXEL_M, "but where a voxel falls between two pixels: rounding decides"
    assert off.max() < VOXEL_M


@pytest.mark.parametrize("tilt_deg", [8.0, 20.0, 60.0])
def test_a_floor_seen_at_a_grazing_angle_is_flat(tilt_deg: float) -> None:
    tilt = np.radians(tilt_deg)
    T = looking(np.array([0.0, 0.0, 0.4]), np.array([np.cos(tilt), 0.01, 0.4 - np.sin(tilt)]))
    mesh = fused([T], floor_depth)
    off = np.abs(mesh.vertices[:, 2])
    assert np.quantile(off, 0.95) < 0.05 * VOXEL_M, "but for the border, it is exact: 1/z is affine on a plane"
    assert off.max() < 1.001 * VOXEL_M
    np.testing.assert_allclose(mesh.colors, 0.5, atol=1e-5, err_msg="of voxels that have a colour")


def test_a_floor_between_two_layers_of_blocks_has_no_cracks() -> None:
    """A millimetre above the last voxel of a block: the rays' truncation, 6 mm across, ends before the next block."""
    T = looking(np.array([0.0, 0.0, 0.4]), np.array([0.99, 0.01, 0.26]))
    faces = {}
    for height_m in (0.045, 0.071):
        up, depth, volume = se3.exp(np.array([0, 0, height_m, 0, 0, 0])), floor_depth(T), Tsdf()
        volume.integrate(depth, gray(depth), CAMERA, up @ T)
        faces[height_m] = len(extract_surface(volume).faces)
    assert faces[0.071] > 0.95 * faces[0.045] > 10_000


def test_a_crack_with_a_far_view_through_it_harms_nothing() -> None:
    T = looking(np.array([0.0, 0.0, 1.0]), np.array([0.001, 0.0, 0.0]))
    whole = floor_depth(T)
    cracked = whole.copy()
    cracked[:, 80], cracked[60] = 7.0, 7.0
    count = len(fused([T], lambda T: whole).vertices)
    height_m = fused([T], lambda T: cracked).vertices[:, 2]
    assert 0.9 * count < (np.abs(height_m) < 1e-4).sum() < count, "the floor is there, but for the crack"


def test_no_reading_makes_no_surface() -> None:
    T = looking(np.array([0.0, 0.0, 1.0]), np.array([0.02, 0.0, 0.0]))
    depth = floor_depth(T)
    assert len(fused([T], lambda T: np.zeros_like(depth)).vertices) == 0
    holed, weight = depth.copy(), np.ones_like(depth)
    holed[40:80, 60:100] = 0.0
    weight[40:80, 60:100] = 0.0
    mesh = fused([T], lambda T: holed)
    seen = (mesh.vertices - T[:3, 3]) @ T[:3, :3]
    u, v = (CAMERA.fx * seen[:, 0] / seen[:, 2] + 79.5, CAMERA.fy * seen[:, 1] / seen[:, 2] + 59.5)
    assert not ((u > 62) & (u < 97) & (v > 42) & (v < 77)).any() and len(mesh.vertices) > 5000
    volume = Tsdf()
    volume.integrate(depth, gray(depth), CAMERA, T, weight)
    assert extract_surface(volume).vertices.tobytes() == mesh.vertices.tobytes(), "no weight is no reading"


def test_weights_weigh() -> None:
    T = looking(np.array([0.0, 0.0, 1.0]), np.array([0.001, 0.0, 0.0]))
    depth, volume = floor_depth(T), Tsdf()
    volume.integrate(depth, gray(depth), CAMERA, T, np.full_like(depth, 3.0))
    volume.integrate(depth + np.float32(0.012), gray(depth), CAMERA, T, np.full_like(depth, 1.0))
    assert np.median(extract_surface(volume).vertices[:, 2]) == pytest.approx(-0.003, abs=2e-4)


def test_colours_are_those_of_the_images() -> None:
    T = looking(np.array([0.0, 0.0, 1.0]), np.array([0.001, 0.0, 0.0]))
    depth, volume = floor_depth(T), Tsdf()
    color = np.zeros((120, 160, 3), np.float32)
    color[:, :80, 0], color[:, 80:, 2] = 0.8, 0.6
    for brighter in (-0.1, 0.1):
        volume.integrate(depth, color + np.float32(brighter) * (color > 0), CAMERA, T)
    mesh = extract_surface(volume)
    right = ((mesh.vertices - T[:3, 3]) @ T[:3, :3])[:, 0]
    assert mesh.colors is not None
    np.testing.assert_allclose(
        mesh.colors[right < -0.02], np.broadcast_to([0.8, 0, 0], (np.sum(right < -0.02), 3)), atol=1e-5
    )
    np.testing.assert_allclose(
        mesh.colors[right > 0.02], np.broadcast_to([0, 0, 0.6], (np.sum(right > 0.02), 3)), atol=1e-5
    )


def test_empty_space_has_no_colour() -> None:
    """A second, fainter image sees blue 20 cm behind the green floor: what is left of the floor stays green."""
    T = looking(np.array([0.0, 0.0, 1.0]), np.array([0.001, 0.0, 0.0]))
    depth, volume = floor_depth(T), Tsdf()
    volume.integrate(depth, np.broadcast_to([0, 0.8, 0], (120, 160, 3)), CAMERA, T)
    volume.integrate(depth * 1.2, np.broadcast_to([0, 0, 0.8], (120, 160, 3)), CAMERA, T, np.full_like(depth, 0.2))
    mesh = extract_surface(volume)
    green = mesh.colors[mesh.vertices[:, 2] > -0.05]
    assert len(green) > 5000
    np.testing.assert_allclose(green, np.broadcast_to([0, 0.8, 0], green.shape), atol=1e-5)


def test_free_space_erases_what_one_image_saw_there() -> None:
    T = looking(np.array([0.0, 0.0, 1.0]), np.array([0.001, 0.0, 0.0]))
    depth = floor_depth(T)
    ghost = depth.copy()
    ghost[50:70, 70:90] = 0.6
    once, often = Tsdf(), Tsdf()
    for volume, images in ((once, [ghost]), (often, [ghost, depth, depth])):
        for image in images:
            volume.integrate(image, gray(image), CAMERA, T)
    assert (extract_surface(once).vertices[:, 2] > 0.3).sum() > 50
    assert not (extract_surface(often).vertices[:, 2] > 0.3).any()


def test_small_parts_are_dropped() -> None:
    ball = sphere()
    crumb = Mesh(np.float32([[1, 0, 0], [1, 1, 0], [1, 0, 1]]), np.int32([[0, 1, 2]]))
    both = Mesh.concatenated([ball, crumb])
    kept = both.without_small_parts(200)
    np.testing.assert_array_equal(kept.vertices, ball.vertices)
    np.testing.assert_array_equal(kept.faces, ball.faces)
    assert len(both.without_small_parts(3).faces) == len(both.faces)
    assert len(both.without_small_parts(10**6).vertices) == 0
    assert len(kept.without_small_parts(10**6).without_small_parts(200).faces) == 0


def test_points_are_drawn_evenly_over_the_area() -> None:
    """A square of 1 m² beside one of 4 m²: four fifths of the points fall on the larger."""
    corners = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [5, 0, 0], [7, 0, 0], [7, 2, 0], [5, 2, 0]])
    mesh = Mesh(corners, np.int32([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]))
    points = mesh.sampled(20_000, seed=1)
    large = points[points[:, 0] >= 5]
    assert mesh.areas().sum() == pytest.approx(5.0) and len(large) / 20_000 == pytest.approx(0.8, abs=0.01)
    quarter = ((large[:, 0] < 6) & (large[:, 1] < 1)).mean()
    assert quarter == pytest.approx(0.25, abs=0.02) and (points[:, 2] == 0).all()
    assert (mesh.sampled(50, 3) == mesh.sampled(50, 3)).all() and (mesh.sampled(50, 3) != mesh.sampled(50, 4)).any()


def test_a_moved_mesh_keeps_its_shape() -> None:
    T = se3.exp(np.array([1.0, -2, 3, 0.3, 0.2, -1.0]))
    moved = sphere().moved(T)
    np.testing.assert_allclose(
        np.linalg.norm(moved.vertices - (T[:3, :3] @ CENTER + T[:3, 3]), axis=1).mean(), RADIUS_M, atol=2e-3
    )
    assert volume_m3(moved.moved(se3.inverse(T))) == pytest.approx(volume_m3(sphere()), rel=1e-4)


def test_block_coordinates_survive_packing_in_order() -> None:
    blocks = np.random.default_rng(0).integers(-(2**20), 2**20, (500, 3))
    np.testing.assert_array_equal(unpacked(packed(blocks)), blocks)
    order = np.lexsort(blocks.T[::-1])
    assert (np.diff(packed(blocks[order])) >= 0).all()


def test_voxels_that_cannot_be_are_refused() -> None:
    for voxel_m, truncation_m in [(0.0, 0.04), (-0.01, 0.04), (0.03, 0.04), (float("nan"), 0.04)]:
        with pytest.raises(ConfigError, match="a voxel must be above 0"):
            Tsdf(voxel_m, truncation_m)


def test_meshes_that_cannot_be_are_refused() -> None:
    points, face = np.zeros((3, 3), np.float32), np.int32([[0, 1, 2]])
    for vertices, faces, colors in (
        (points[:, :2], face, None), (points, face + 1, None), (points, face - 1, None), (points * np.nan, face, None),
        (points, face, points[:2]),
    ):  # fmt: skip
        with pytest.raises(SigmaSplatError, match="a mesh"):
            Mesh(vertices, faces, colors)
