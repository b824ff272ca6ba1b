"""Scores of splats with a known result: lattices with known gaps, shifts, hidden splats, floaters."""

import numpy as np
import pytest

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.mesh import Mesh
from sigmasplat.plugins.evaluation.metrics.reconstruction import FLOATER_M, OPAQUE, score_splats

CAMERA = Camera(80, 60, 60.0, 60.0, 39.5, 29.5)
AHEAD = np.eye(4)[None]
HALF_M, CELLS = 0.6, 30
GAP_M = 2 * HALF_M / CELLS
MEAN_TO_CENTER = (np.sqrt(2) + np.arcsinh(1)) / 6
"""Mean distance of the points of the unit square to its centre."""


def wall(z_m: float) -> Mesh:
    """Return a square perpendicular to the z axis of the world, two triangles per cell."""
    steps = np.linspace(-HALF_M, HALF_M, CELLS + 1)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    n = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (corner.ravel() for corner in (n[:-1, :-1], n[1:, :-1], n[1:, 1:], n[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    return Mesh(np.stack([x.ravel(), y.ravel(), np.full(x.size, z_m)], 1).astype(np.float32), faces)


def lattice(z_m: float) -> np.ndarray:
    """Return one splat centre in the middle of each cell of the wall, at this depth."""
    middles = (np.arange(CELLS) + 0.5) * GAP_M - HALF_M
    x, y = np.meshgrid(middles, middles, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z_m)], 1)


def scored(centers: np.ndarray, opacities: np.ndarray | float = 0.9, truth: Mesh | None = None) -> dict[str, float]:
    opaque = np.broadcast_to(opacities, len(centers))
    return score_splats(centers, opaque, truth or wall(2.0), CAMERA, AHEAD, points=20_000)


def test_splats_on_the_surface_have_an_error_from_the_gaps_between_them() -> None:
    found = scored(lattice(2.0))
    assert found["splats_accuracy_m"] < 1e-7 and found["floaters"] == 0.0
    assert found["splats_completion_m"] == pytest.approx(MEAN_TO_CENTER * GAP_M, rel=0.01)
    assert found["splats_chamfer_m"] == pytest.approx(found["splats_completion_m"] / 2, rel=1e-5)


@pytest.mark.parametrize("shift_m", [-0.08, -0.02, 0.03])
def test_a_shift_off_the_surface_equals_the_distance(shift_m: float) -> None:
    found = scored(lattice(2.0 + shift_m))
    assert found["splats_accuracy_m"] == pytest.approx(abs(shift_m), rel=1e-4)
    rng = np.random.default_rng(1)
    in_cell = np.hypot(*rng.uniform(-GAP_M / 2, GAP_M / 2, (2, 100_000)))
    assert found["splats_completion_m"] == pytest.approx(np.hypot(in_cell, shift_m).mean(), rel=0.01)
    assert found["splats_chamfer_m"] == pytest.approx((found["splats_accuracy_m"] + found["splats_completion_m"]) / 2)


def test_a_floater_is_opaque_and_far_from_the_surface_even_if_hidden() -> None:
    on, near, before, behind = (lattice(z)[:100] for z in (2.0, 2.0 - 0.9 * FLOATER_M, 2.0 - 1.1 * FLOATER_M, 2.5))
    centers = np.concatenate([on, near, before, behind])
    opacities = np.repeat([0.9, 0.9, 0.9, 0.9], 100)
    assert scored(centers, opacities)["floaters"] == 0.5
    opacities[250:] = 0.9 * OPAQUE  # half of those in front, and all behind
    assert scored(centers, opacities)["floaters"] == pytest.approx(50 / 250), "share of the opaque splats"
    mean_m = (0.0 + 0.9 * FLOATER_M + 1.1 * FLOATER_M) / 3
    assert scored(centers, opacities)["splats_accuracy_m"] == pytest.approx(mean_m, rel=1e-4), (
        "visible splats of any opacity"
    )


def test_only_the_visible_part_of_the_truth_counts() -> None:
    unseen = wall(2.0).moved(se3.exp(np.array([5.0, 0, 0, 0, 0, 0])))
    both, alone = Mesh.concatenated([wall(2.0), unseen]), scored(lattice(2.0))
    assert scored(lattice(2.0), truth=both)["splats_completion_m"] == pytest.approx(
        alone["splats_completion_m"], rel=0.02
    )
    there = np.concatenate([lattice(2.0), lattice(2.0) + np.array([5.0, 0, 0])])
    assert scored(there, truth=both)["floaters"] == 0.0, "a splat on a surface that no view saw is no floater"


def test_without_splats_distances_are_infinite_or_nan() -> None:
    found = scored(np.empty((0, 3)))
    assert (
        np.isnan(found["splats_accuracy_m"]) and found["splats_completion_m"] == np.inf and np.isnan(found["floaters"])
    )
    faint = scored(lattice(2.0), 0.05)
    assert np.isnan(faint["floaters"]) and faint["splats_accuracy_m"] < 1e-7
