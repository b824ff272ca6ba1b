"""Covariance of a path: marginals, loops, and the choice of world, against dense inverses and solved graphs."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from constants import changed
from paper_settings import FinalConfig, RenderConfig, paper_settings
from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.relative_pose import UNKNOWN_HOP, Edges, Kind, RelativePose, TrackedHops
from sigmasplat.final.final_map import reaching
from sigmasplat.fit.align import BIAS_PX
from sigmasplat.graph.path_covariance import PathCovariance, recorded
from sigmasplat.graph.pose_graph import PoseGraph, Sensitivity, optimise

Array = NDArray[np.float64]
LOOSE, STIFF = np.diag([400.0] * 3 + [900.0] * 3), np.diag([1e4] * 3 + [4e4] * 3)
KEYFRAMES, SUBMAPS = 3, 4
NO_BIAS = np.zeros(6)


def covariance_of(rng: np.random.Generator, scale: float) -> Array:
    A = scale * rng.normal(size=(6, 6))
    return A @ A.T + 0.1 * scale**2 * np.eye(6)


def world_of(solution: Array, keyframes: list[list[Array]]) -> Atlas:
    """Return an atlas of solved submaps; its frames are its keyframes."""
    atlas = Atlas()
    for s, T_world_submap in enumerate(solution):
        atlas.begin_submap()
        atlas.anchors[-1], atlas.components[-1] = T_world_submap, 0
        for k in range(len(keyframes[s])):
            atlas.set_keyframes(keyframes[s][: k + 1], UNKNOWN_HOP)
            atlas.place_frame(keyframes[s][k])
    return atlas


class Loopy:
    """Four submaps of three hops each, walked as a square, with a loop from the last to the first one."""

    def __init__(self, bias: Array = NO_BIAS) -> None:
        rng = np.random.default_rng(1)
        step = np.array([0.3, 0.02, -0.05, 0.03, np.pi / 2 / KEYFRAMES, 0.02])
        self.steps = [[se3.exp(-step + 0.05 * rng.normal(size=6)) for _ in range(KEYFRAMES)] for _ in range(SUBMAPS)]
        self.covariances = [[covariance_of(rng, 1e-3) for _ in range(KEYFRAMES)] for _ in range(SUBMAPS)]
        self.bias = bias
        ends = np.eye(4)
        for steps in self.steps[:-1]:
            for T_camera_before in steps:
                ends = ends @ se3.inverse(T_camera_before)
        self.loop = RelativePose(SUBMAPS - 1, 0, se3.inverse(ends), STIFF, kind="loop")

    def loop_between(self, in_last: int, in_first: int) -> RelativePose:
        """Return the loop as one that compares two other keyframes, with a drift that only its information contains."""
        drift = 1e-4 * np.eye(6)
        information = np.linalg.inv(np.linalg.inv(STIFF) + drift)
        return replace(self.loop, information=information, keyframes=(in_last, in_first), drift=drift)

    def drifted(self, loop: RelativePose, keyframes: list[list[Array]]) -> RelativePose:
        """Return a loop between keyframes that have moved in their submaps; the motion between the two is as before."""
        (last, first), (in_last, in_first) = (self.keyframes({})[s] for s in (-1, 0)), loop.keyframes
        T_last_first = se3.inverse(last[in_last]) @ loop.T_a_b @ first[in_first]
        return replace(loop, T_a_b=keyframes[-1][in_last] @ T_last_first @ se3.inverse(keyframes[0][in_first]))

    def keyframes(self, errors: dict[tuple[int, int], Array]) -> list[list[Array]]:
        """Return T_submap_keyframe, with errors of some hops."""
        chains = []
        for s, steps in enumerate(self.steps):
            chain = [np.eye(4)]
            for k, T_camera_before in enumerate(steps):
                wrong = se3.exp(errors.get((s, k), np.zeros(6))) @ T_camera_before
                chain.append(chain[-1] @ se3.inverse(wrong))
            chains.append(chain)
        return chains

    def edges(self, keyframes: list[list[Array]], loop: RelativePose | None) -> list[RelativePose]:
        chain = [RelativePose(s, s + 1, keyframes[s][-1], LOOSE) for s in range(SUBMAPS - 1)]
        return chain if loop is None else [*chain, loop]

    def solved(
        self, errors: dict[tuple[int, int], Array], loop: RelativePose | None
    ) -> tuple[Atlas, list[RelativePose]]:
        keyframes = self.keyframes(errors)
        edges = self.edges(keyframes, loop and self.drifted(loop, keyframes))
        start = [np.eye(4)]
        for chain in keyframes[:-1]:
            start.append(start[-1] @ chain[-1])
        return world_of(optimise(np.stack(start), edges, confidence=1.0).T_world_node, keyframes), edges

    def covariance(self, loop: RelativePose | None, hops: bool = True) -> PathCovariance:
        (atlas, edges), tracked = self.solved({}, loop), TrackedHops()
        for s in range(SUBMAPS):
            known = [
                RelativePose.hop(T, C, self.bias) for T, C in zip(self.steps[s], self.covariances[s], strict=True)
            ] if hops else [UNKNOWN_HOP] * KEYFRAMES  # fmt: skip
            for hop in (UNKNOWN_HOP, *known):
                tracked.append(hop)
        atlas.hops = tracked
        found = PathCovariance.of(checkpoint(atlas, edges))
        assert found is not None
        return found


def checkpoint(atlas: Atlas, edges: list[RelativePose]) -> dict[str, torch.Tensor]:
    kept = Edges()
    for edge in edges:
        kept.append(edge)
    return recorded(atlas, kept) | {
        "keyframes": torch.arange(len(atlas.places)),
        "T_world_submap": torch.from_numpy(np.stack(atlas.anchors)),
        "submap_component": torch.tensor(atlas.components),
        "frame_submap": torch.tensor([place.submap for place in atlas.places]),
    }


def test_marginals_are_the_blocks_of_the_dense_inverse() -> None:
    rng = np.random.default_rng(0)
    T = np.stack([se3.exp(rng.normal(size=6)) for _ in range(30)])
    chosen = [(i, i + 1) for i in range(29)] + [(0, 12), (3, 29), (20, 5), (17, 8)]
    edges = []
    for a, b in chosen:
        information = np.linalg.inv(covariance_of(rng, 0.02))
        measured = se3.exp(0.01 * rng.normal(size=6)) @ se3.inverse(T[a]) @ T[b]
        kind: Kind = "loop" if b != a + 1 else "odometry"
        edges.append(RelativePose(a, b, measured, 0.5 * (information + information.T), kind))
    H, _ = PoseGraph(len(T), edges).normal_equations(T, np.ones(len(edges)))
    dense = np.linalg.inv(H.toarray())
    sensitivity, information = Sensitivity(T, edges), np.stack([edge.information for edge in edges])

    def marginal(node: int) -> Array:
        G = sensitivity.of(node)
        return np.asarray((G @ np.linalg.inv(information) @ np.swapaxes(G, 1, 2)).sum(0))

    assert not marginal(0).any()
    for node in (1, 7, 15, 29):
        block = dense[6 * node - 6 : 6 * node, 6 * node - 6 : 6 * node]
        np.testing.assert_allclose(marginal(node), block, rtol=1e-9, atol=1e-9 * np.abs(block).max())


@pytest.mark.parametrize("keyframes", [None, (0, 0), (2, 0), (0, 2), (1, 3)])
def test_covariances_follow_from_the_errors_of_hops_and_loops(keyframes: tuple[int, int] | None) -> None:
    """Each error moves the solved path; the covariance is the sum over all errors, for poses and for motions.

    A loop between two keyframes also has the errors of the hops to them.
    """
    room, closed = Loopy(), keyframes is not None
    loop = None if keyframes is None else room.loop if keyframes == (0, 0) else room.loop_between(*keyframes)
    path, h = room.covariance(loop), 1e-5
    pairs = [(2, 7), (1, len(path) - 1), (3, 4), (6, 6)]
    poses, motions = np.zeros((len(path), 6, 6)), np.zeros((len(pairs), 6, 6))
    plain = room.solved({}, loop)[0].T_world_camera()
    units: list[tuple[tuple[int, int] | None, Array, Array]] = [
        ((s, k), unit, room.covariances[s][k]) for s in range(SUBMAPS) for k in range(KEYFRAMES) for unit in np.eye(6)
    ]
    units += [(None, unit, np.linalg.inv(STIFF)) for unit in np.eye(6)] if closed else []
    slopes: dict[tuple[int, int] | None, list[tuple[Array, Array]]] = {}
    for place, unit, _ in units:
        error = h * unit
        turned = (
            None if loop is None else replace(loop, T_a_b=se3.exp(error if place is None else 0 * error) @ loop.T_a_b)
        )
        moved = room.solved({} if place is None else {place: error}, turned)[0].T_world_camera()
        between = [
            se3.log(se3.inverse(moved[a]) @ moved[b] @ se3.inverse(se3.inverse(plain[a]) @ plain[b])) for a, b in pairs
        ]
        slope = se3.log_stack(moved @ se3.inverse(plain)) / h, np.array(between) / h
        slopes.setdefault(place, []).append(slope)
    covariances = {place: C for place, _, C in units}
    for place, C in covariances.items():
        J = np.stack([poses_of for poses_of, _ in slopes[place]], axis=2)
        K = np.stack([motions_of for _, motions_of in slopes[place]], axis=2)
        poses += J @ C @ np.swapaxes(J, 1, 2)
        motions += K @ C @ np.swapaxes(K, 1, 2)
    for frame in range(len(path)):
        np.testing.assert_allclose(path.of_frame(frame), poses[frame], atol=2e-3 * np.abs(poses[-1]).max())
    for (a, b), expected in zip(pairs, motions, strict=True):
        np.testing.assert_allclose(path.between(a, b), expected, atol=2e-3 * max(np.abs(expected).max(), 1e-12))


def test_a_loop_reduces_the_covariance() -> None:
    room = Loopy()
    sure = replace(room.loop, information=1e7 * np.eye(6))
    chain, closed = room.covariance(None), room.covariance(sure)
    assert not chain.of_frame(0).any() and not closed.of_frame(0).any()
    for frame in range((SUBMAPS - 1) * (KEYFRAMES + 1), len(chain)):
        assert np.trace(closed.of_frame(frame)) < 0.9 * np.trace(chain.of_frame(frame))


def test_another_world_turns_the_covariance_and_leaves_motions_alone() -> None:
    path, W = Loopy(np.full(6, 1e-4)).covariance(Loopy().loop), se3.exp(np.array([1.0, -2.0, 0.5, 0.3, 1.0, -0.4]))
    moved, A = replace(path, anchors=W @ path.anchors), se3.adjoint(W)
    for frame in (0, 5, len(path) - 1):
        np.testing.assert_allclose(moved.of_frame(frame), A @ path.of_frame(frame) @ A.T, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(moved.between(2, frame), path.between(2, frame), rtol=1e-6, atol=1e-12)


def test_bias_grows_with_the_number_of_hops_and_noise_with_its_root() -> None:
    straight = [[se3.exp(np.array([0.0, 0.0, -0.1, 0.0, 0.0, 0.0]))] * KEYFRAMES] * SUBMAPS

    def std_m(covariance: Array, bias: Array, hops: int) -> float:
        room = Loopy(bias)
        room.steps, room.covariances = straight, [[covariance] * KEYFRAMES] * SUBMAPS
        path = room.covariance(None)
        return float(np.sqrt(path.of_frame(hops + hops // (KEYFRAMES + 1))[2, 2]))

    noise, bias = np.diag([1e-6] * 3 + [1e-14] * 3), np.array([1e-3] * 3 + [1e-7] * 3)
    assert std_m(noise, NO_BIAS, 3) == pytest.approx(np.sqrt(3) * 1e-3, rel=0.01)
    assert std_m(1e-12 * np.eye(6), bias, 3) == pytest.approx(3e-3, rel=0.01)
    assert 0.001 < BIAS_PX < 1 / 40


def test_poses_that_mapping_moves_are_less_certain() -> None:
    """The disagreement between tracking and mapping is an error that alignment does not estimate."""
    room = Loopy()
    sure = room.covariance(None)
    shift = se3.exp(np.array([5e-3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    hops = sure.hops
    tracked = hops.T_camera_before
    tracked[1::2] = shift @ tracked[1::2]
    moved = replace(sure, hops=TrackedHops.joined(tracked, hops.covariance, hops.bias, hops.camera))
    assert moved.between(0, 1)[0, 0] > sure.between(0, 1)[0, 0] + 0.2 * 5e-3**2


def test_an_unknown_hop_is_uncertain_by_a_metre_and_old_checkpoints_have_no_errors() -> None:
    path = Loopy().covariance(None, hops=False)
    assert path.of_frame(1)[0, 0] > 0.5
    assert PathCovariance.of({"T_world_submap": torch.eye(4)[None]}) is None
    recent = checkpoint(Loopy().solved({}, None)[0], [])
    del recent["hop_camera"]  # a version before the camera's errors were kept
    found = PathCovariance.of(recent)
    assert found is not None and not found.hops.camera.any() and len(found.hops) == SUBMAPS * (KEYFRAMES + 1)


def test_each_component_has_its_own_origin() -> None:
    room = Loopy()
    path = room.covariance(None)
    apart = replace(path, components=np.array([0, 0, 2, 2]), edges=(path.edges[0], path.edges[2]))
    first = 2 * (KEYFRAMES + 1)
    assert not apart.of_frame(first).any() and apart.of_frame(first + 1).any()
    np.testing.assert_allclose(apart.of_frame(first - 1), path.of_frame(first - 1))


def test_a_frame_that_is_no_keyframe_adds_the_error_of_its_own_motion() -> None:
    """Also if it is at the very pose of its keyframe, as in a frozen recording."""
    path = Loopy().covariance(None)
    loose = replace(path, is_keyframe=np.arange(len(path)) != 1)
    own = loose.of_frame(1) - path.of_frame(1)
    assert (np.linalg.eigvalsh(own) > 0).all()
    T = loose.T_world_camera[1]
    hop = se3.adjoint(se3.inverse(T)) @ own @ se3.adjoint(se3.inverse(T)).T
    np.testing.assert_allclose(hop, Loopy().covariances[0][1], rtol=1e-6, atol=1e-14)


def settings(final: Any) -> Config:
    return paper_settings(final=final)


def test_refinement_moves_poses_as_far_as_the_path_may_be_wrong() -> None:
    path = Loopy().covariance(Loopy().loop)
    std_m = np.median([np.sqrt(np.trace(path.of_frame(frame)[:3, :3])) for frame in range(len(path))])
    final = FinalConfig(pose_reach_m=1e-4, pose_reach_most_m=1.0, lr_pose_translation=3e-5, lr_pose_rotation=2e-5)
    found = reaching(settings(final), path)
    assert 1e-3 < found.pose_reach_m == pytest.approx(0.5 * std_m)
    for name in ("lr_pose_translation", "lr_pose_rotation"):
        assert getattr(found, name) / getattr(final, name) == pytest.approx(found.pose_reach_m / 1e-4)
    assert reaching(settings(changed(final, pose_reach_most_m=2e-4)), path).pose_reach_m == 2e-4
    unknown = Loopy().covariance(None, hops=False)
    kept = reaching(settings(final), unknown)
    assert kept.pose_reach_m == 1e-4 and kept.lr_pose_rotation == 2e-5, "the errors of descent are not estimated"
    exact = changed(final, pose_reach_m=0.1)
    assert reaching(settings(exact), path).pose_reach_m == 0.1, "an exact path keeps its reach"
    still = changed(final, pose_reach_most_m=0.0)
    assert reaching(settings(still), path).pose_reach_m == 1e-4
    off = changed(final, pose_reach_m=0.0)
    assert reaching(settings(off), path) is off
    large = replace(settings(final), render=RenderConfig(scene_scale=10.0))
    grown = reaching(large, unknown)
    assert (grown.pose_reach_m, grown.lr_pose_translation, grown.lr_pose_rotation) == pytest.approx((1e-3, 3e-4, 2e-5))
