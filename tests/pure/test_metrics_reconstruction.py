"""Scores of meshes with a known result: identical, shifted, halved, hidden; distances and depth by another method."""

import numpy as np
import pytest

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.mesh import Mesh, mesh_depth
from sigmasplat.plugins.evaluation.metrics.reconstruction import (
    correct,
    distances,
    score,
    visible_points,
)

CAMERA = Camera(80, 60, 60.0, 60.0, 39.5, 29.5)
EMPTY = Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))


def grid(columns: int, rows: int, place: np.ndarray) -> Mesh:
    """Cover the unit square with triangles, and map each point (s, t) to `place`(s, t) [N, 3]."""
    s, t = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1), indexing="ij")
    n = np.arange(s.size).reshape(s.shape)
    a, b, c, d = n[:-1, :-1].ravel(), n[1:, :-1].ravel(), n[1:, 1:].ravel(), n[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return Mesh(np.stack(place(s.ravel(), t.ravel()), 1).astype(np.float32), faces.astype(np.int32))


def ball(radius_m: float = 1.0) -> Mesh:
    """Return a sphere around the origin; the corners of its faces are exactly on it."""

    def place(s: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, ...]:
        level = radius_m * np.sin(np.pi * t)
        return level * np.cos(2 * np.pi * s), level * np.sin(2 * np.pi * s), radius_m * np.cos(np.pi * t)

    return grid(120, 60, place)


def wall(z_m: float, half_m: float = 0.6) -> Mesh:
    """Return a square perpendicular to the z axis of the world."""
    return grid(30, 30, lambda s, t: ((2 * s - 1) * half_m, (2 * t - 1) * half_m, np.full_like(s, z_m)))


def around(views: int = 12, distance_m: float = 3.0) -> np.ndarray:
    """Return poses around the origin that look at it."""
    back = se3.exp(np.array([0, 0, -distance_m, 0, 0, 0]))
    turns = [np.array([0, 0, 0, 0, 2 * np.pi * k / views, 0]) for k in range(views)]
    turns += [np.array([0, 0, 0, side * np.pi / 2, 0, 0]) for side in (-1, 1)]
    return np.stack([se3.exp(turn) @ back for turn in turns])


AHEAD = np.eye(4)[None]


def scored(found: Mesh, truth: Mesh, poses: np.ndarray) -> dict[str, float]:
    return score(found, truth, CAMERA, poses, points=10_000)


def test_a_surface_compared_with_itself_is_perfect() -> None:
    found = scored(ball(), ball(), around())
    assert found["accuracy_m"] < 1e-5 and found["completion_m"] < 1e-5
    shares = [found["completion_ratio"], found["precision"], found["recall"], found["f1"]]
    assert shares == pytest.approx([1.0] * 4, abs=1e-3), "except for faces at the border of the visible part"


def test_a_shift_along_the_normals_equals_the_distance() -> None:
    for shift_m, near, complete in [(0.005, 1, 1), (0.02, 0, 1), (-0.02, 0, 1), (0.08, 0, 0)]:
        found = scored(ball(1.0 + shift_m), ball(), around())
        assert found["accuracy_m"] == pytest.approx(abs(shift_m), rel=0.03)
        assert found["completion_m"] == pytest.approx(abs(shift_m), rel=0.03)
        assert [found["precision"], found["recall"], found["f1"]] == pytest.approx([near] * 3, abs=1e-3)
        assert found["completion_ratio"] == pytest.approx(complete, abs=1e-3)


def test_half_a_surface_is_half_complete_and_fully_accurate() -> None:
    whole = ball()
    half = whole.with_faces(whole.corners.mean(1)[:, 0] > 0)
    found = scored(half, whole, around())
    # A point is complete within the limit of the half. The area of a spherical zone is proportional to its height.
    assert found["completion_ratio"] == pytest.approx(0.5 + 0.05 / 2, abs=0.01)
    assert found["recall"] == pytest.approx(0.5 + 0.01 / 2, abs=0.01)
    assert found["accuracy_m"] < 1e-5 and found["precision"] > 0.999 and found["f1"] == pytest.approx(2 / 3, abs=0.02)
    back = scored(whole, half, around())
    assert back["completion_ratio"] > 0.999 and back["accuracy_m"] > 0.1, (
        "the other way round it is the accuracy that suffers"
    )


def test_surfaces_that_no_camera_saw_do_not_count() -> None:
    front, hidden = wall(2.0), wall(3.0, half_m=0.5)
    truth = Mesh.concatenated([front, hidden])
    assert scored(front, truth, AHEAD)["completion_ratio"] == 1.0, "the wall behind is hidden"
    assert scored(truth, front, AHEAD)["accuracy_m"] < 1e-6, "a surface behind it is hidden too"
    behind = around(2)[1]
    behind[2, 3] += 2.0
    seen = scored(front, truth, np.stack([AHEAD[0], behind]))
    assert seen["completion_ratio"] < 0.7 and seen["completion_m"] > 0.3, "it counts if seen from the other side"
    aside = Mesh.concatenated([front, wall(2.0).moved(se3.exp(np.array([5.0, 0, 0, 0, 0, 0])))])
    assert scored(front, aside, AHEAD)["completion_ratio"] == scored(aside, front, AHEAD)["precision"] == 1.0


def test_a_false_surface_in_front_counts() -> None:
    front = wall(2.0)
    found = scored(Mesh.concatenated([front, wall(1.5, half_m=0.6)]), front, AHEAD)
    assert found["precision"] == pytest.approx(0.5, abs=0.02) and found["accuracy_m"] == pytest.approx(0.25, abs=0.01)
    assert found["recall"] == 1.0


def test_an_empty_mesh_has_no_precision_and_zero_recall() -> None:
    found = scored(EMPTY, wall(2.0), AHEAD)
    assert np.isnan(found["accuracy_m"]) and np.isnan(found["precision"])
    assert found["completion_ratio"] == found["recall"] == 0.0 and found["completion_m"] == np.inf
    assert correct(np.ones(2), np.ones(2))["f1"] == 0.0
    assert correct(np.zeros(2), np.arange(2.0))["f1"] == pytest.approx(2 / 3)


def test_the_same_meshes_get_the_same_scores() -> None:
    found = ball(1.01).moved(se3.exp(np.array([0.01, 0, 0, 0.1, 0, 0])))
    assert scored(found, ball(), around()) == scored(found, ball(), around())


def test_distances_to_triangles_equal_distances_to_dense_points_on_them() -> None:
    rng = np.random.default_rng(5)
    mesh = Mesh(rng.normal(size=(12, 3)).astype(np.float32), np.arange(12, dtype=np.int32).reshape(4, 3))
    points = 1.5 * rng.normal(size=(300, 3))
    s, t = np.meshgrid(np.linspace(0, 1, 80), np.linspace(0, 1, 80))
    inside = s + t <= 1 + 1e-9
    s, t = s[inside][:, None], t[inside][:, None]
    net = np.concatenate([a + s * (b - a) + t * (c - a) for a, b, c in mesh.corners])
    brute = np.sqrt(((points[:, None] - net) ** 2).sum(-1)).min(1)
    ours = distances(points, mesh)
    assert (ours <= brute + 1e-9).all() and np.abs(ours - brute).max() < 0.02 and np.median(brute - ours) < 1e-3
    assert distances(net[::97], mesh).max() < 1e-7 and (distances(points, EMPTY) == np.inf).all()


def test_depth_of_a_slanted_plane_is_exact_and_the_nearer_face_wins() -> None:
    """The plane z = 2 + ½x, and a small square in front of it."""
    plane = grid(20, 20, lambda s, t: (2 * s - 1, 2 * t - 1, 2 + 0.5 * (2 * s - 1)))
    square = wall(1.2, half_m=0.2)
    depth_m, face = mesh_depth(Mesh.concatenated([plane, square]), CAMERA, np.eye(4))
    x, y = np.moveaxis(CAMERA.rays(), 2, 0)[:2].astype(float)
    expected = 2 / (1 - 0.5 * x)
    before = (np.abs(1.2 * x) < 0.199) & (np.abs(1.2 * y) < 0.199)
    on = (
        (np.abs(expected * x) < 0.99)
        & (np.abs(expected * y) < 0.99)
        & ~((np.abs(1.2 * x) < 0.201) & (np.abs(1.2 * y) < 0.201))
    )
    np.testing.assert_allclose(depth_m[before], 1.2, atol=1e-6)
    np.testing.assert_allclose(depth_m[on], expected[on], rtol=1e-6)
    assert (face[before] >= len(plane.faces)).all() and ((face[on] >= 0) & (face[on] < len(plane.faces))).all()
    assert (depth_m[face < 0] == 0).all() and (face < 0).any() and before.sum() > 100


def test_faces_behind_or_at_the_camera_are_not_visible() -> None:
    for mesh in (wall(-1.0), wall(0.01), EMPTY, wall(2.0).moved(se3.exp(np.array([9.0, 0, 0, 0, 0, 0])))):
        depth_m, face = mesh_depth(mesh, CAMERA, np.eye(4))
        assert not depth_m.any() and (face == -1).all()


def test_points_are_visible_up_to_the_depth_plus_a_tolerance() -> None:
    depth_m = np.full((60, 80), 2.0, np.float32)
    depth_m[:, :40] = 0.0  # no surface: points behind are visible
    points = np.array([[0.3, 0, 1.0], [0.3, 0, 2.04], [0.3, 0, 2.06], [-0.3, 0, 9.0], [0.3, 0, -1.0], [9, 0, 1.0]])
    assert visible_points(points, depth_m, CAMERA, np.eye(4), 0.05).tolist() == [True, True, False, True, False, False]
