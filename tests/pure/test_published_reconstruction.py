"""Scores by the protocol of published systems, against brute force on small meshes: points, rays, boxes."""

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.mesh import Mesh, mesh_depth
from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.evaluation.metrics.published_reconstruction import (
    aligned_by_icp,
    dense_points,
    depth_errors,
    oriented_box,
    random_views,
    score_published,
)

SMALL = Camera(36, 30, 20.0, 20.0, 17.5, 14.5)
TURN = se3.exp(np.array([0.4, -0.2, 0.3, 0.3, 0.5, -0.2]))
SIDES = np.array([5.0, 4.0, 2.6])


def room(scale: float = 1.0, edge_m: float = 0.9) -> Mesh:
    """Return the walls of a room, turned, in faces of at most `edge_m`."""
    box = trimesh.creation.box(SIDES * scale)
    return Mesh(box.vertices.astype(np.float32), box.faces.astype(np.int32)).subdivided(edge_m).moved(TURN)


def all_of(mesh: Mesh) -> NDArray[np.bool_]:
    return np.ones(len(mesh.faces), bool)


def cast(mesh: Mesh, camera: Camera, T_world_camera: np.ndarray, near_m: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """Return depth and face of each pixel by intersecting every ray with every triangle (Möller and Trumbore)."""
    rays = camera.rays().reshape(-1, 3).astype(float) @ T_world_camera[:3, :3].T
    start, depth, face = T_world_camera[:3, 3], np.full(len(rays), np.inf), np.full(len(rays), -1)
    for number, (a, b, c) in enumerate(mesh.corners):
        if (
            se3.inverse(T_world_camera)[2, :3] @ np.stack([a, b, c]).T + se3.inverse(T_world_camera)[2, 3]
        ).min() <= near_m:
            continue
        normal = np.cross(rays, c - a)
        determinant = normal @ (b - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = normal @ (start - a) / determinant
            across = np.cross(start - a, b - a)
            v, t = rays @ across / determinant, (c - a) @ across / determinant
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < depth)
        depth[hit], face[hit] = t[hit], number
    shape = camera.height, camera.width
    return np.where(face >= 0, depth, 0.0).reshape(shape), face.reshape(shape)


def nearest_by_brute_force(points: np.ndarray, among: np.ndarray) -> np.ndarray:
    return np.array([np.sqrt(((among - point) ** 2).sum(1).min()) for point in points])


def test_rendered_depth_equals_rays_through_every_pixel() -> None:
    walls = Mesh.concatenated([room(), room(0.4)])
    for k in range(4):
        T = TURN @ se3.exp(np.array([1.4, 0.2 * k, 0.1, 0.7 * k, 0.3 + k, 0.2]))
        depth_m, face = mesh_depth(walls, SMALL, se3.inverse(T))
        expected, expected_face = cast(walls, SMALL, T)
        np.testing.assert_array_equal(face >= 0, expected_face >= 0)
        np.testing.assert_allclose(depth_m, expected, atol=1e-5)
        assert (face == expected_face).mean() > 0.98, "rays through an edge belong to two faces"


def test_points_are_scored_as_by_brute_force() -> None:
    truth, found = room(edge_m=0.25), room(0.99, edge_m=0.4)
    seen_found = found.corners.mean(1)[:, 0] > -1.0
    scores = score_published(found, truth, all_of(truth), seen_found, points=900, views=0, seed=4)
    ours = found.with_faces(seen_found)
    ours = ours.moved(aligned_by_icp(ours.vertices.astype(float), truth.vertices.astype(float)))
    a, b = ours.sampled(900, 4), truth.sampled(900, 5)
    there, back = nearest_by_brute_force(a, b), nearest_by_brute_force(b, a)
    assert scores["accuracy_m"] == pytest.approx(there.mean()) and scores["completion_m"] == pytest.approx(back.mean())
    assert scores["chamfer_m"] == pytest.approx((there.mean() + back.mean()) / 2)
    assert scores["completion_ratio"] == pytest.approx((back < 0.05).mean())
    assert np.isnan(scores["depth_l1_m"]) and scores["depth_views"] == 0


def test_f1_equals_brute_force() -> None:
    """With 4000 vertices on a small ball many points are within 1 cm of a point of the other mesh."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
    found = Mesh(ball.vertices.astype(np.float32), ball.faces.astype(np.int32))
    coarse = trimesh.creation.icosphere(subdivisions=3, radius=0.302)
    truth = Mesh(coarse.vertices.astype(np.float32), coarse.faces.astype(np.int32))
    scores = score_published(found, truth, all_of(truth), all_of(found), points=10, views=0, seed=1)
    moved = found.moved(aligned_by_icp(found.vertices.astype(float), truth.vertices.astype(float)))
    a, b = dense_points(moved, truth, 3)
    assert len(a) == len(b) == len(found.vertices)
    precision = (nearest_by_brute_force(a, b) < 0.01).mean()
    recall = (nearest_by_brute_force(b, a) < 0.01).mean()
    assert 0.3 < precision < 0.99 and (scores["precision"], scores["recall"]) == pytest.approx((precision, recall))
    assert scores["f1"] == pytest.approx(2 * precision * recall / (precision + recall))
    assert [len(points) for points in dense_points(truth, moved, 0)] == [len(found.vertices)] * 2


def test_depth_equals_brute_force_over_seen_parts() -> None:
    truth, found = room(), room(0.97)
    found = found.with_faces(found.areas() > np.quantile(found.areas(), 0.1))
    seen = np.arange(len(truth.faces)) % 40 != 0
    expected = []
    for T, depth_m, counted in random_views(truth, seen, 4, SMALL, seed=2):
        theirs, face = cast(truth, SMALL, T)
        ours, _ = cast(found, SMALL, T)
        np.testing.assert_allclose(depth_m, theirs, atol=1e-5)
        both = (face >= 0) & seen[face] & (ours > 0)
        assert (counted[both]).mean() > 0.98 and ((face >= 0) & ~seen[face]).mean() <= 0.06
        expected.append(np.abs(theirs - ours)[both].mean())
    errors = depth_errors(found, truth, seen, views=4, camera=SMALL, seed=2)
    assert len(errors) == len(expected) == 4
    np.testing.assert_allclose(errors, expected, rtol=0.03)


def test_random_views_are_inside_the_room_and_repeatable() -> None:
    truth = room()
    views = list(random_views(truth, all_of(truth), 30, SMALL, seed=7))
    inside = np.array([(se3.inverse(TURN) @ T)[:3, 3] for T, *_ in views])
    assert len(views) == 30 and (np.abs(inside) <= SIDES / 2 * [0.7, 0.7, 0.3] + 1e-4).all()
    assert np.linalg.matrix_rank(inside - inside.mean(0)) == 3
    for T, depth_m, counted in views:
        assert se3.is_rigid(T) and counted.all() and depth_m.min() > 0
    again = list(random_views(truth, all_of(truth), 30, SMALL, seed=7))
    assert all((a[0] == b[0]).all() for a, b in zip(views, again, strict=True))


def test_views_of_unseen_parts_are_drawn_again() -> None:
    truth = room(edge_m=0.3)
    seen = (truth.corners.mean(1) - TURN[:3, 3]) @ TURN[:3, 0] < 1.0  # one end of the room was never in view
    views = list(random_views(truth, seen, 20, SMALL, seed=0))
    assert 0 < len(views) <= 20 and all(counted.mean() >= 0.95 for *_, counted in views)
    assert list(random_views(truth, ~all_of(truth), 20, SMALL, seed=0)) == []


def test_icp_finds_a_small_motion() -> None:
    points = room(edge_m=0.2).sampled(4000, 0)
    T = se3.exp(np.array([0.01, -0.02, 0.015, 0.004, -0.003, 0.005]))
    found = aligned_by_icp(points, points @ T[:3, :3].T + T[:3, 3])
    np.testing.assert_allclose(found, T, atol=2e-3)
    np.testing.assert_array_equal(aligned_by_icp(points, points + 50.0), np.eye(4))


def test_the_box_of_a_turned_room_has_its_sides() -> None:
    center, axes, sides = oriented_box(room().vertices.astype(float))
    np.testing.assert_allclose(sides, np.sort(SIDES), atol=1e-3)
    np.testing.assert_allclose(center, TURN[:3, 3], atol=1e-3)
    np.testing.assert_allclose(np.abs(axes.T @ TURN[:3, [2, 1, 0]]), np.eye(3), atol=1e-3)


def test_the_box_holds_all_points_and_is_at_most_as_large_as_that_of_trimesh() -> None:
    points = np.random.default_rng(0).normal(size=(60, 3)) @ np.diag([3.0, 1.0, 0.5])
    _, expected = trimesh.bounds.oriented_bounds(points)
    center, axes, sides = oriented_box(points)
    assert sides.prod() <= 1.001 * expected.prod() and (np.diff(sides) >= 0).all()
    reached = np.abs((points - center) @ axes).max(0)
    np.testing.assert_allclose(reached, sides / 2, rtol=1e-5)
    flat = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
    assert oriented_box(flat)[2] == pytest.approx([0, 1, 2], abs=1e-6)


def test_faces_are_divided_without_changing_the_surface() -> None:
    coarse = Mesh(
        np.array([[0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 0.05]], np.float32),
        np.array([[0, 1, 2], [0, 3, 2]], np.int32),
    )
    fine = coarse.subdivided(0.5)
    edges = np.linalg.norm(fine.corners - np.roll(fine.corners, 1, axis=1), axis=2)
    assert edges.max() <= 0.5 and fine.areas().sum() == pytest.approx(coarse.areas().sum())
    assert fine.vertices.min(0).tolist() == [0, 0, 0] and fine.vertices.max(0) == pytest.approx([3, 2, 0.05])
    assert fine.subdivided(0.5) is fine
    with pytest.raises(SigmaSplatError, match="more than 0"):
        coarse.subdivided(0.0)
