"""Drift within a submap: first-order sums against drawn chains, and the rules that cut by it."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from paper_settings import SubmapConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.tracking.drift import BIAS, HOP_M, HOP_RAD, Drift
from sigmasplat.tracking.keyframe_rule import ends_submap

Matrix = NDArray[np.float64]
OWN = np.diag(np.repeat([HOP_M**2, HOP_RAD**2], 3))


def chain(hops: int) -> list[Matrix]:
    """Poses T_submap_keyframe of a camera that turns and walks."""
    step = se3.exp(np.array([0.2, -0.05, 0.1, 0.05, 0.2, -0.1]))
    poses = [np.eye(4)]
    for _ in range(hops):
        poses.append(poses[-1] @ step)
    return poses


def spread(hop: Matrix, draws: int = 20_000) -> tuple[Matrix, float]:
    """Draw noisy chains: each hop is T_camera_reference with a left twist; return the end's covariance and position."""
    random, poses = np.random.default_rng(0), chain(6)
    half = np.linalg.cholesky(hop)
    T = np.tile(np.eye(4), (draws, 1, 1))
    for before, after in pairwise(poses):
        noise = se3.exp_stack(random.standard_normal((draws, 6)) @ half.T)
        T = T @ se3.inverse(noise @ (se3.inverse(after) @ before))
    shifts = T[:, :3, 3] - poses[-1][:3, 3]
    return np.cov(se3.log_stack(T @ se3.inverse(poses[-1])).T), float(np.sqrt((shifts**2).sum(1).mean()))


def test_the_sum_over_hops_is_what_drawn_chains_scatter_by() -> None:
    hop = np.diag([4e-6, 1e-6, 9e-6, 1e-6, 4e-6, 2e-6])
    hop[0, 4] = hop[4, 0] = 1.5e-6
    drift = Drift()
    for T in chain(6)[1:]:
        drift.hop(T, hop)
    covariance, position_m = spread(hop)
    scale = np.sqrt(np.diag(covariance))
    assert np.abs((drift.covariance - covariance) / np.outer(scale, scale)).max() < 0.04
    assert drift.position_m(chain(6)[-1]) == pytest.approx(position_m, rel=0.02)


def test_it_starts_at_nothing_and_grows_with_each_hop() -> None:
    drift, poses = Drift(), chain(5)
    found = [drift.position_m(np.eye(4))]
    for T in poses[1:]:
        drift.hop(T, OWN)
        found.append(drift.position_m(T))
    assert found[0] == 0.0
    assert np.all(np.diff(found) > 0.0)


def test_a_hop_of_unknown_covariance_counts_as_a_usual_one() -> None:
    drift = Drift()
    drift.hop(np.eye(4), None)
    assert drift.position_m(np.eye(4)) == 0.0
    assert np.allclose(drift.information @ OWN, np.eye(6))


def test_a_hop_without_overlap_carries_no_information() -> None:
    for nothing in [np.inf, np.nan]:
        drift = Drift()
        drift.hop(np.eye(4), np.full((6, 6), nothing))
        assert drift.position_m(np.eye(4)) > 1.0
        assert np.linalg.eigvalsh(drift.information)[-1] < 1.1


def test_what_is_bent_grows_with_the_way_not_with_its_root() -> None:
    """Twice the way, twice the deviation: noise alone would give √2."""
    deviations = []
    for steps in (1, 2):
        drift, T = Drift(), np.eye(4)
        T[0, 3] = 2.0
        for k in range(1, steps + 1):
            T[0, 3] = 2.0 * k
            drift.hop(T, None)
        deviations.append(float(np.sqrt(np.linalg.inv(drift.information)[0, 0])))
    assert deviations[1] == pytest.approx(2 * deviations[0], rel=0.01)
    assert deviations[0] == pytest.approx(BIAS * 2.0, rel=0.01)


def test_each_rule_alone_ends_a_submap_unless_it_is_off() -> None:
    T = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(30.0), 0.0]))
    T[:3, 3] = [0.3, 0.4, 0.0]
    for rule, config in (
        ("distance", SubmapConfig(distance_m=0.4)),
        ("angle", SubmapConfig(distance_m=1.0, angle_deg=25.0)),
        ("frames", SubmapConfig(frames=10)),
        ("uncertainty", SubmapConfig(uncertainty_m=0.015)),
        ("", SubmapConfig(distance_m=0.6, angle_deg=35.0, frames=11, uncertainty_m=0.025)),
        ("", SubmapConfig()),
    ):
        assert ends_submap(T, 10, 0.02, config) == rule


def test_constant_errors_in_metres_follow_the_scale_of_the_scene() -> None:
    room, street = Drift(), Drift(scene_scale=5.0)
    for drift in (room, street):
        drift.hop(np.eye(4), None)
    ratio = np.diag(street.usual) / np.diag(room.usual)
    np.testing.assert_allclose(ratio, [25.0] * 3 + [1.0] * 3)
    z = np.zeros((64, 64), np.float32) + 8.0
    z[::2] += 0.1  # the ground, far away
    of = [Pyramid.of(np.ones_like(z), z, Camera(64, 64, 60, 60, 31.5, 31.5), scene_scale=s) for s in (1.0, 5.0)]
    assert not of[0].depth[1].any() and (of[1].depth[1] > 0).all()
