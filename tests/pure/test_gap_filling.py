"""Gaps of a mesh are closed by patches near the true surface; borders, rims and large gaps stay open."""

import numpy as np
import pytest
from skimage.measure import marching_cubes

from sigmasplat.data.mesh import Mesh
from sigmasplat.plugins.outputs.mesh_editing import decimated, filled, gaps
from sigmasplat.plugins.outputs.mesh_files import read_mesh, write_mesh

STEP_M, RADIUS_M = 0.03, 0.48


def of_distance(distance_m, noise_m=0.0):
    """The surface where a function of points is 0, in cells of 3 cm, as a TSDF gives it, with noise."""
    grid = np.mgrid[:40, :40, :40] * STEP_M - 0.6 + 0.004
    points, faces, _, _ = marching_cubes(distance_m(grid), 0.0, gradient_direction="descent")
    points = points * STEP_M - 0.6 + 0.004 + noise_m * np.random.default_rng(0).normal(size=points.shape)
    colors = np.clip(points + 0.5, 0.0, 1.0)
    return Mesh(*(a.astype(t) for a, t in ((points, np.float32), (faces, np.int32), (colors, np.float32))),
                np.full(len(points), 0.004, np.float32))  # fmt: skip


def without(mesh, centre_m, width_m):
    return mesh.with_faces(np.linalg.norm(mesh.corners.mean(1) - centre_m, axis=1) > width_m / 2)


SPHERE = of_distance(lambda p: np.linalg.norm(p, axis=0) - RADIUS_M)
PLANE = of_distance(lambda p: 0.2 * p[0] - 0.1 * p[1] + p[2])
UP = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])


def open_edges(mesh):
    sides = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    _, uses = np.unique(sides, axis=0, return_counts=True)
    return int((uses == 1).sum()), int(uses.max())


@pytest.mark.parametrize(("width_m", "noise_m"), [(0.15, 0.0), (0.3, 0.0), (0.3, 0.001)])
def test_a_patch_is_near_the_sphere_that_it_closes(width_m, noise_m):
    noisy = of_distance(lambda p: np.linalg.norm(p, axis=0) - RADIUS_M, noise_m)
    broken = without(noisy, np.array([0.0, 0.0, RADIUS_M]), width_m)
    closed = filled(broken, 1.5 * width_m)
    new = closed.vertices[len(broken.vertices) :]
    off_m = np.abs(np.linalg.norm(new, axis=1) - RADIUS_M)
    flat_m = width_m**2 / (8 * RADIUS_M)  # the error of a flat lid
    assert len(new) > 5 and off_m.max() < 0.5 * flat_m + 2 * noise_m and off_m.mean() < 0.25 * flat_m + noise_m
    assert open_edges(closed) == (0, 2)
    corners = closed.corners[len(broken.faces) :]
    outward = (corners.mean(1) * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).sum(1)
    assert outward[outward < 0].sum() > -0.02 * outward.sum()
    np.testing.assert_array_equal(closed.vertices[: len(broken.vertices)], broken.vertices)


def test_a_patch_of_a_plane_is_flat_and_uncertain_and_has_the_colours_of_its_edge(tmp_path):
    broken = without(PLANE, np.zeros(3), 0.4)
    closed, old = filled(broken, 0.6), len(broken.vertices)
    new, std = closed.vertices[old:], closed.depth_std_m[old:]
    assert np.abs(new @ UP).max() < 1e-4
    distance = np.linalg.norm(new[:, None] - broken.vertices[None], axis=2).min(1)
    order = np.argsort(distance)
    assert std[order[-1]] > 0.05 and std.min() > 0.004 and np.corrcoef(std, distance)[0, 1] > 0.99
    assert np.abs(closed.colors[old:] - np.clip(new + 0.5, 0, 1)).max() < 0.05
    assert closed.filled[old:].all() and not closed.filled[:old].any()
    write_mesh(tmp_path / "a.ply", closed)
    assert b"property uchar filled\n" in (tmp_path / "a.ply").read_bytes()[:600]
    assert len(read_mesh(tmp_path / "a.ply").vertices) == len(closed.vertices)
    small = decimated(closed, len(closed.faces) // 3)
    off_m = np.linalg.norm(small.vertices, axis=1)
    assert small.filled[off_m < 0.1].all() and not small.filled[off_m > 0.25].any()


def test_borders_rims_and_large_gaps_stay_open():
    two = without(without(PLANE, np.array([0.3, 0.0, -0.06]), 0.15), np.array([-0.3, 0.0, 0.06]), 0.35)
    assert len(gaps(two, 10.0)) == 2 and len(gaps(two, 0.25)) == 1
    assert open_edges(filled(two, 0.25))[0] < open_edges(two)[0]
    cup = of_distance(lambda p: np.hypot(p[0], p[1]) - 0.3)  # a tube, open at both ends
    assert not gaps(cup, 10.0)
    patch = PLANE.with_faces(np.linalg.norm(PLANE.corners.mean(1), axis=1) < 0.1)
    assert not gaps(patch, 10.0)
    assert filled(two, 0.0) is two and filled(SPHERE, 1.0) is SPHERE
    assert filled(two, -1.0) is two


def test_gaps_that_touch_at_a_vertex_are_closed_one_by_one():
    across = PLANE.vertices @ np.array([1.0, 0.0, 0.0])
    vertex = int(np.argmin(np.linalg.norm(PLANE.vertices, axis=1)))
    near = (PLANE.faces == vertex).any(1)
    keep = ~(near & (across[PLANE.faces].mean(1) > across[vertex]))
    others = np.isin(PLANE.faces, PLANE.faces[near & (across[PLANE.faces].mean(1) < across[vertex])][:1, :2]).any(1)
    broken = PLANE.with_faces(keep & ~(others & near))
    assert open_edges(filled(broken, 0.5)) == (open_edges(PLANE)[0], 2)
