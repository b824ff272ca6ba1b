"""The graph of keyframes: its solution, the factors it measures, which views are aligned, and splats that follow."""

import itertools

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.relative_pose import Kind, RelativePose
from sigmasplat.final.stores import followed, nearest_view
from sigmasplat.graph.keyframe_graph import NEAR, partners, solve

Array = NDArray[np.float64]
HOP, ALIGNMENT = np.array([0.004] * 3 + [0.002] * 3), np.array([0.002] * 3 + [0.001] * 3)  # m, rad
CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)


def circle(nodes: int) -> Array:
    step = se3.exp(np.array([0.1, 0.0, 0.02, 0.0, 2 * np.pi / nodes, 0.0]))
    return np.stack([np.linalg.matrix_power(step, i) for i in range(nodes)])


def measured(truth: Array, a: int, b: int, std: Array, rng: np.random.Generator, kind: Kind, claimed: float = 1.0):
    """Measure T_a_b with this standard deviation, and claim it times `claimed`."""
    T_a_b = se3.exp(rng.normal(size=6) * std) @ se3.inverse(truth[a]) @ truth[b]
    return RelativePose(a, b, T_a_b, np.diag((claimed * std) ** -2.0), kind)


def chained(edges: list[RelativePose]) -> Array:
    return np.stack(list(itertools.accumulate(edges, lambda T, hop: T @ se3.inverse(hop.T_a_b), initial=np.eye(4))))


def hops(truth: Array, rng: np.random.Generator, claimed: float = 1.0) -> list[RelativePose]:
    return [measured(truth, i, i - 1, HOP, rng, "hop", claimed) for i in range(1, len(truth))]


def alignments(truth: Array, rng: np.random.Generator, claimed: float = 1.0) -> list[RelativePose]:
    pairs = [(i, j) for i in range(len(truth)) for j in (i - 1, i - 2, i - 5) if j >= 0]
    pairs += [(len(truth) - 1 - i, i) for i in range(3)]  # the path ends where it began
    return [measured(truth, *pair, ALIGNMENT, rng, "alignment", claimed) for pair in pairs]


def off_m(poses: Array, truth: Array) -> float:
    return float(np.sqrt(((poses - truth)[:, :3, 3] ** 2).sum(1).mean()))


def test_alignments_take_the_drift_out_of_a_chain() -> None:
    truth, rng = circle(60), np.random.default_rng(0)
    chain = hops(truth, rng)
    start = chained(chain)
    found = solve(start, [*chain, *alignments(truth, rng)]).T_world_keyframe
    assert off_m(start, truth) > 0.02
    assert off_m(found, truth) < 0.2 * off_m(start, truth)
    assert np.array_equal(found[0], start[0])


def test_far_edges_correct_a_drift_that_is_ten_times_what_is_claimed() -> None:
    """With a loss that lets outliers go, the drifted poses would stay where they are, and the far edges would lose."""
    truth, rng = circle(60), np.random.default_rng(1)
    bent = se3.exp(np.array([0.0, 0.002, 0.0, 0.0, 0.0, 0.004]))  # the same error in every hop
    chain = [RelativePose(h.a, h.b, bent @ h.T_a_b, 1e2 * h.information, "hop") for h in hops(truth, rng)]
    far = [measured(truth, i, j, ALIGNMENT, rng, "alignment") for i in range(20, 60) for j in (i - 20, i - 10)]
    start = chained(chain)
    found = solve(start, [*chain, *far]).T_world_keyframe
    assert off_m(start, truth) > 0.1
    assert off_m(found, truth) < 0.1 * off_m(start, truth)


def test_a_wrong_alignment_among_right_ones_hardly_moves_the_path() -> None:
    truth, rng = circle(60), np.random.default_rng(2)
    edges = [*hops(truth, rng), *alignments(truth, rng)]
    wrong = RelativePose(
        40, 20, se3.exp(np.array([0.5, 0, 0, 0, 0, 0.3])) @ edges[0].T_a_b, edges[-1].information, "alignment"
    )
    found = solve(chained(edges[:59]), [*edges, wrong]).T_world_keyframe
    assert off_m(found, truth) < 0.01


@pytest.mark.parametrize("claimed", [0.25, 1.0, 3.0])
def test_factors_are_those_of_the_errors(claimed: float) -> None:
    truth, rng = circle(120), np.random.default_rng(3)
    edges = [*hops(truth, rng, claimed), *alignments(truth, rng)]
    factors = solve(chained(edges[:119]), edges).factors
    assert factors["hop"] == pytest.approx(claimed**-2.0, rel=0.35)
    assert factors["alignment"] == pytest.approx(1.0, rel=0.35)


def test_a_chain_alone_stays_as_it_is() -> None:
    truth, rng = circle(10), np.random.default_rng(4)
    chain = hops(truth, rng)
    start = chained(chain)
    assert np.array_equal(solve(start, chain).T_world_keyframe, start)


def test_poses_of_earlier_sessions_stay() -> None:
    truth, rng = circle(40), np.random.default_rng(5)
    edges = [*hops(truth, rng), *alignments(truth, rng)]
    start = chained(edges[:39])
    found = solve(start, edges, fixed=10).T_world_keyframe
    assert np.array_equal(found[:10], start[:10]) and not np.allclose(found[20], start[20], atol=1e-6)


def test_the_solution_does_not_depend_on_the_world() -> None:
    truth, rng = circle(40), np.random.default_rng(6)
    edges, T_new_old = [*hops(truth, rng), *alignments(truth, rng)], se3.exp(np.array([3.0, -2.0, 1.0, 0.5, 1.0, -0.7]))
    start = chained(edges[:39])
    there = solve(T_new_old @ start, edges).T_world_keyframe
    assert np.allclose(there, T_new_old @ solve(start, edges).T_world_keyframe, atol=1e-9)


# ---- which views ----


def test_partners_are_near_in_view_and_spread_in_time() -> None:
    """The path goes along a wall and comes back beside the way out."""
    out = [se3.exp(np.array([0.1 * i, 0.0, 0.0, 0.0, 0.0, 0.0])) for i in range(20)]
    back = [se3.exp(np.array([0.1 * (19 - i), 0.05, 0.0, 0.0, 0.0, 0.0])) for i in range(20)]
    path = np.stack([*out, *back])
    found = partners(path[:36], depth_m=2.0, width_rad=1.0, most=8)
    assert found[0] == 34 and len(found) == len(set(found)) <= 8
    assert any(k < 20 for k in found[1:])  # the way out, where the same part of the wall is seen
    newest = path[35]
    for k in found[1:]:
        assert np.linalg.norm((se3.inverse(newest) @ path[k])[:3, 3]) / 2.0 < NEAR
    rest = sorted(found[3:])
    assert all(b - a >= 4 for a, b in itertools.pairwise(rest))
    assert partners(path[:36], 2.0, 1.0, 1) == [34]
    assert partners(path[:2], 2.0, 1.0, 8) == [0]


def test_a_view_in_another_direction_is_no_partner() -> None:
    behind = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))
    assert partners(np.stack([np.eye(4), behind, behind]), 2.0, 1.0, 8) == [1]


# ---- splats that follow ----


def points(*at: tuple[float, float, float]) -> GaussianField:
    means = torch.tensor(at)
    return GaussianField.from_values(means, torch.full_like(means, 0.01), torch.full_like(means, 0.5))


def test_a_splat_belongs_to_the_nearest_keyframe_that_sees_it() -> None:
    T = np.stack([np.eye(4), se3.exp(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))])
    at = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 0.5], [0.0, 0.0, -1.0], [0.3, 0.0, 1.2]])
    assert nearest_view(at, T, CAMERA).tolist() == [1, 0, 0, 0]


def test_splats_move_with_their_keyframes() -> None:
    before = np.stack([np.eye(4), se3.exp(np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.0]))])
    motions = np.stack([se3.exp(np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.2])), np.eye(4)])
    field = points((5.0, 0.0, 2.0), (0.1, 0.2, 2.0))
    moved = followed(field, before, motions @ before, CAMERA)
    expected = field.part(torch.tensor([False, True])).moved(torch.from_numpy(motions[0]))
    assert torch.equal(moved.means[0], expected.means[0]) and torch.equal(moved.quats[0], expected.quats[0])
    assert torch.allclose(moved.means[1], field.means[0], atol=1e-6) and len(moved) == 2


def test_a_common_motion_moves_all_splats_alike() -> None:
    rng = np.random.default_rng(0)
    T = np.stack([se3.exp(0.3 * rng.normal(size=6)) for _ in range(5)])
    field = points(*map(tuple, rng.normal(size=(50, 3)).tolist()))
    common = se3.exp(rng.normal(size=6))
    moved = followed(field, T, common @ T, CAMERA)
    expected = field.moved(torch.from_numpy(common)).means.numpy()
    order = np.lexsort(moved.means.numpy().T), np.lexsort(expected.T)
    assert np.allclose(moved.means.numpy()[order[0]], expected[order[1]], atol=1e-5)


def test_an_empty_map_stays_empty() -> None:
    assert len(followed(GaussianField.empty(), np.eye(4)[None], np.eye(4)[None], CAMERA)) == 0
