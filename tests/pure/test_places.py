"""Loop candidates against VarSplat §4 written out, on descriptors whose angles are known."""

from collections.abc import Iterable
from itertools import permutations
from typing import Any

import numpy as np
import pytest

from sigmasplat.data import se3
from sigmasplat.graph import candidates
from sigmasplat.graph.candidates import (
    Candidate,
    DescribedSubmaps,
    SubmapDescriptor,
    SubmapPair,
    gate,
    opacity_ratio,
    self_similarity,
    variance_weights,
)

DEGREE = np.pi / 180


def at(*degrees: float) -> np.ndarray:
    """Descriptors in a plane: their similarity is the cosine of the angle between them."""
    angles = np.array(degrees) * DEGREE
    return np.stack([np.cos(angles), np.sin(angles)], -1).astype(np.float32)


def known(submaps: Iterable[SubmapDescriptor]) -> DescribedSubmaps:
    made = DescribedSubmaps()
    for submap in submaps:
        made.append(submap)
    return made


def find_candidates(
    query: SubmapDescriptor, others: Iterable[SubmapDescriptor], *args: Any, **named: Any
) -> list[Candidate]:
    return candidates.find_candidates(query, known(others), *args, **named)


def find_nearby(
    query: SubmapDescriptor, others: Iterable[SubmapDescriptor], *args: Any, **named: Any
) -> list[SubmapPair]:
    return candidates.find_nearby(query, known(others), *args, **named)


def pairs_to_register(
    found: list[Candidate], query: SubmapDescriptor, others: Iterable[SubmapDescriptor], *args: Any, **named: Any
) -> list[SubmapPair]:
    return candidates.pairs_to_register(found, query, known(others), *args, **named)


def splats(seed: int = 0, count: int = 501) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return random.uniform(0.05, 1.0, count), random.normal(-6.0, 3.0, (count, 3))


def test_variance_weights_equal_the_formula_written_out() -> None:
    _, log_variances = splats()
    log_mean = np.log(np.exp(log_variances).mean(1))
    plain = np.exp(-(log_mean - np.median(log_mean)) / 2.0)
    expected = np.clip(plain / plain.mean(), 1 / 3, 3.0)
    found = variance_weights(log_variances, tau=2.0, weight_max=3.0)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert found.min() == 1 / 3 and found.max() == 3.0, "the bounds must have been at work"


def test_the_texts_weights_and_gate_have_no_limits_and_no_mean() -> None:
    """VarSplat eq. 18: w = exp(−(log σ̄² − median)/τ), and the similarity times r(q) · r(d)."""
    log_variances = np.random.default_rng(3).normal(-7.0, 3.0, (401, 3))
    log_mean = np.log(np.exp(log_variances).mean(1))
    expected = np.exp(-(log_mean - np.median(log_mean)) / 2.0)
    np.testing.assert_allclose(variance_weights(log_variances, 2.0, plain=True), expected, rtol=1e-12)
    assert expected.max() > 3.0 and expected.min() < 1 / 3.0
    opacities = np.random.default_rng(4).uniform(0.1, 1.0, 401)
    ratio = opacity_ratio(opacities, log_variances, 2.0, plain=True)
    assert ratio == pytest.approx((expected * opacities).sum() / opacities.sum())
    assert gate(0.5, 0.5, plain=True) == 0.25 and gate(3.0, np.array([2.0]), plain=True).tolist() == [6.0]
    steady = [SubmapDescriptor(4, at(-25, 85), opacity_ratio=2.0)]
    for plain, factor in ((False, 1.2), (True, 2.0)):
        found = find_candidates(QUERY, steady, plain=plain)
        assert found and [c.gated for c in found] == pytest.approx([factor * c.similarity for c in found])


def test_opacity_ratio_equals_the_formula_and_knows_steady_from_restless() -> None:
    opacities, log_variances = splats()
    w = variance_weights(log_variances)
    assert opacity_ratio(opacities, log_variances) == pytest.approx(float((w * opacities).sum() / opacities.sum()))
    restless = np.repeat([-12.0, -2.0], 50)[:, None] * np.ones(3)
    assert opacity_ratio(np.repeat([0.9, 0.1], 50), restless) > 1.05
    assert opacity_ratio(np.repeat([0.1, 0.9], 50), restless) < 0.95


def test_a_common_factor_in_all_variances_changes_nothing() -> None:
    for shift in [-40.0, -3.0, 5.0, 60.0]:
        opacities, log_variances = splats()
        ratio = opacity_ratio(opacities, log_variances, tau=3.0)
        assert opacity_ratio(opacities, log_variances + shift, tau=3.0) == pytest.approx(ratio, rel=1e-12)
        assert ratio != pytest.approx(1.0, abs=1e-3)


def test_equal_variances_or_nothing_opaque_give_ratio_one() -> None:
    opacities, log_variances = splats()
    assert opacity_ratio(opacities, np.full_like(log_variances, -7.0)) == pytest.approx(1.0, rel=1e-12)
    assert opacity_ratio(np.zeros(501), log_variances) == 1.0
    assert opacity_ratio(np.zeros(0), np.zeros((0, 3))) == 1.0


def test_the_order_of_splats_and_channels_and_the_unit_of_opacity_do_not_matter() -> None:
    opacities, log_variances = splats()
    ratio = opacity_ratio(opacities, log_variances)
    order = np.random.default_rng(1).permutation(len(opacities))
    assert opacity_ratio(opacities[order], log_variances[order]) == pytest.approx(ratio, rel=1e-12)
    for channels in permutations(range(3)):
        assert opacity_ratio(opacities * 0.3, log_variances[:, channels]) == pytest.approx(ratio, rel=1e-12)


def test_the_spread_of_variances_may_be_extreme() -> None:
    log_variances = np.linspace(-1e5, 1e5, 11)[:, None] * np.ones(3)
    w = variance_weights(log_variances)
    assert np.isfinite(w).all() and w[0] == 3.0 and (w[1:] == pytest.approx(1 / 3))


def test_the_gate_is_the_clamped_product_and_symmetric() -> None:
    assert gate(1.02, 1.05) == pytest.approx(1.071) and gate(1.0, 1.0) == 1.0
    assert gate(0.9, 0.9) == 0.85 and gate(0.5, 0.5) == 0.85
    assert gate(1.2, 1.1) == 1.20 and gate(3.0, 3.0) == 1.20
    assert gate(1.13, 0.87) == gate(0.87, 1.13)


def test_self_similarity_is_the_kth_highest_itself_included() -> None:
    descriptors = at(0, 10, 30, 60, 100)  # from 0°: 1, cos 10°, cos 30°, …
    # ⌊5 · 0.5⌋ = 2: the nearest neighbour. ⌊5 · 0.34⌋ = 1: itself. ⌊5 · 0.8⌋ = 4: the third.
    np.testing.assert_allclose(self_similarity(descriptors, 0.5), np.cos(np.array([10, 10, 20, 30, 40]) * DEGREE), 1e-6)
    np.testing.assert_allclose(self_similarity(descriptors, 0.34), 1.0, 1e-6)
    np.testing.assert_allclose(
        self_similarity(descriptors, 0.8), np.cos(np.array([60, 50, 30, 50, 90]) * DEGREE), 1e-6, 1e-6
    )
    assert self_similarity(at(7))[0] == pytest.approx(1.0) and self_similarity(at()).shape == (0,)


def pairs(candidates: list[Candidate]) -> set[tuple[int, int, int]]:
    return {(c.query_keyframe, c.database_submap, c.database_keyframe) for c in candidates}


# Thresholds of the query: cos 20° for each of its four keyframes (k = 2: the nearest neighbour).
QUERY = SubmapDescriptor(9, at(0, 20, 40, 60))
DATABASE = [
    SubmapDescriptor(1, at(-15, 170)),  # 15° from keyframe 0: alike
    SubmapDescriptor(4, at(-25, 85)),  # 25° from keyframes 0 and 3: not quite
    SubmapDescriptor(5, at(30)),  # 10° from 1 and 2
    SubmapDescriptor(8, at(41)),  # 1° from 2 and 19° from 3, but next door
]


def test_candidates_exceed_the_querys_own_threshold_and_lie_far_enough_away() -> None:
    found = find_candidates(QUERY, DATABASE, min_interval=2)
    assert pairs(found) == {(0, 1, 0), (1, 5, 0), (2, 5, 0)}
    for candidate in found:
        assert candidate.gated == candidate.similarity
    assert [c.similarity for c in found] == pytest.approx([np.cos(10 * DEGREE)] * 2 + [np.cos(15 * DEGREE)], rel=1e-6)
    assert pairs(find_candidates(QUERY, DATABASE, min_interval=1)) == pairs(found) | {(2, 8, 0), (3, 8, 0)}
    assert pairs(find_candidates(QUERY, DATABASE, min_interval=5)) == {(0, 1, 0)}
    assert find_candidates(QUERY, DATABASE, min_interval=9) == []
    assert (
        find_candidates(QUERY, []) == [] == find_candidates(SubmapDescriptor(9, np.zeros((0, 2), np.float32)), DATABASE)
    )


def test_a_submap_is_never_a_candidate_of_itself() -> None:
    assert find_candidates(QUERY, [QUERY], min_interval=0) == []


def test_submaps_on_both_sides_count() -> None:
    later = SubmapDescriptor(11, at(30))
    assert pairs(find_candidates(QUERY, [later], min_interval=2)) == {(1, 11, 0), (2, 11, 0)}
    assert find_candidates(QUERY, [later], min_interval=3) == []


def test_the_gate_moves_pairs_across_the_threshold_unless_switched_off() -> None:
    steady = [SubmapDescriptor(4, at(-25, 85), opacity_ratio=1.1)]
    assert pairs(find_candidates(QUERY, steady)) == {(0, 4, 0), (3, 4, 1)}
    assert find_candidates(QUERY, steady)[0].gated == pytest.approx(1.1 * np.cos(25 * DEGREE), rel=1e-6)
    assert find_candidates(QUERY, steady, uncertainty=False) == []
    restless = [SubmapDescriptor(5, at(30), opacity_ratio=0.9)]
    assert find_candidates(QUERY, restless) == []
    ungated = find_candidates(QUERY, restless, uncertainty=False)
    assert pairs(ungated) == {(1, 5, 0), (2, 5, 0)} and all(c.gated == c.similarity for c in ungated)


def test_no_gate_lifts_a_pair_over_the_floor() -> None:
    steady = [SubmapDescriptor(4, at(-25, 85), opacity_ratio=1.2)]
    assert find_candidates(QUERY, steady, similarity_floor=0.91) == []
    assert len(find_candidates(QUERY, steady, similarity_floor=0.90)) == 2
    unlike = SubmapDescriptor(9, at(0, 120, 240))
    assert find_candidates(unlike, [SubmapDescriptor(1, at(100))], min_similarity=1.0, similarity_floor=0.95) == []
    blank = SubmapDescriptor(9, np.zeros((3, 2), np.float32))
    assert find_candidates(blank, [blank, SubmapDescriptor(1, at(0))]) == [], "nothing is like nothing"


def random_signatures(seed: int, count: int = 6) -> list[SubmapDescriptor]:
    random = np.random.default_rng(seed)
    made = []
    for index in range(count):
        vectors = random.normal(size=(int(random.integers(1, 7)), 3)).astype(np.float32)
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        made.append(SubmapDescriptor(index, vectors, float(random.uniform(0.9, 1.1))))
    return made


def test_candidates_are_those_of_a_search_by_hand_whatever_the_order_of_the_database() -> None:
    for seed in range(5):
        everyone = random_signatures(seed)
        query = everyone[5]
        expected = []
        for other in everyone:
            if abs(other.index - 5) < 2:
                continue
            factor = min(max(query.opacity_ratio * other.opacity_ratio, 0.85), 1.2)
            for i, a in enumerate(query.descriptors):
                own = sorted((float(a @ b) for b in query.descriptors), reverse=True)
                threshold = own[max(len(own) // 2, 1) - 1]
                for j, b in enumerate(other.descriptors):
                    if float(a @ b) * factor > threshold and a @ b > 0:
                        expected.append((-float(a @ b) * factor, other.index, i, j))
        found = find_candidates(query, everyone)
        assert [(c.database_submap, c.query_keyframe, c.database_keyframe) for c in found] == [
            key[1:] for key in sorted(expected)
        ]
        assert find_candidates(query, everyone[::-1]) == found
        assert expected, "a search without result shows nothing"


def test_pairs_are_in_the_order_of_their_best_candidates() -> None:
    several = 0
    for seed in range(5):
        everyone = random_signatures(seed, count=12)
        found = find_candidates(everyone[5], everyone, min_similarity=1.0)
        ranking = list(dict.fromkeys(candidate.database_submap for candidate in found))
        pairs = pairs_to_register(found, everyone[5], everyone)
        assert [pair.best.database_submap for pair in pairs] == ranking
        several += len(ranking) > 4
    assert several, "an order of one shows nothing"


def test_a_submap_at_the_threshold_is_no_candidate() -> None:
    query = SubmapDescriptor(9, at(0, 0, 60, 100))  # its twins must exceed 1, the others cos 40°
    same, near = SubmapDescriptor(1, at(0)), SubmapDescriptor(2, at(55))
    assert {c.database_submap for c in find_candidates(query, [same, near])} == {2}


def test_ties_go_by_submap_then_query_keyframe_then_database_keyframe() -> None:
    same = at(0, 0)
    found = find_candidates(
        SubmapDescriptor(9, at(0, 0, 90, 90)), [SubmapDescriptor(2, same), SubmapDescriptor(1, same)], 0.75, 2
    )
    order = [(c.database_submap, c.query_keyframe, c.database_keyframe) for c in found]
    assert order == [(s, q, d) for s in (1, 2) for q in (0, 1) for d in (0, 1)]


def test_each_submap_is_registered_once_by_the_two_most_alike_keyframes_of_each_side() -> None:
    query = SubmapDescriptor(9, at(0, 50, 9, 100, 60), 1.1)
    near, far = SubmapDescriptor(3, at(12, 180, 61, 58), 1.0), SubmapDescriptor(1, at(200, 105), 1.0)
    database = [near, far]
    found = pairs_to_register(find_candidates(query, database, 0.5), query, database)
    assert [p.best.database_submap for p in found] == [3, 1]
    first, second = found
    # 60–61 is 1° apart, then 9–12 with 3°; of submap 3: 61 (1°), then 58 (2°, to 60).
    assert first.query_keyframes == (4, 2) and first.database_keyframes == (2, 3)
    assert (first.best.query_keyframe, first.best.database_keyframe) == (4, 2)
    assert second.query_keyframes == (3, 4) and second.database_keyframes == (1, 0)
    assert len(pairs_to_register(find_candidates(query, database), query, database, 9)[1].database_keyframes) == 2
    assert pairs_to_register([], query, database) == []


def test_equally_alike_keyframes_are_taken_in_order() -> None:
    query, other = SubmapDescriptor(5, at(0, 0, 0, 40, 40, 40)), SubmapDescriptor(1, at(10, 10, 10))
    (pair,) = pairs_to_register(find_candidates(query, [other], 0.7), query, [other])
    assert pair.query_keyframes == (0, 1) == pair.database_keyframes


def standing(*places: tuple[float, float]) -> np.ndarray:
    """Poses by x in metres and yaw in degrees."""
    poses = np.stack([se3.exp(np.array([0, 0, 0, 0, yaw * DEGREE, 0.0])) for _, yaw in places])
    poses[:, 0, 3] = [x for x, _ in places]
    return poses


def test_places_that_should_be_near_are_tried_whatever_they_look_like() -> None:
    signatures = [SubmapDescriptor(k, at(90.0 * k, 90.0 * k)) for k in range(4)]
    poses = [
        standing((0.4, 0.0), (0.1, 5.0)),  # near, the second keyframe more so
        standing((0.0, 40.0), (0.6, 0.0)),  # near but turned away, looking alike but far
        standing((0.0, 0.0), (0.0, 0.0)),  # the neighbour before
        standing((0.0, 0.0), (9.0, 0.0)),
    ]
    (pair,) = find_nearby(signatures[3], signatures[:3], dict(enumerate(poses)), 0.5, 30 * DEGREE, 2)
    assert (pair.best.query_keyframe, pair.best.database_submap, pair.best.database_keyframe) == (0, 0, 1)
    assert pair.best.similarity == pytest.approx(0.0, abs=1e-6)
    assert pair.query_keyframes == (0, 1) and pair.database_keyframes == (1, 0)
    wider = find_nearby(signatures[3], signatures[:3], dict(enumerate(poses)), 0.8, 30 * DEGREE, 1, keyframes=1)
    assert [p.best.database_submap for p in wider] == [2, 0, 1], "the nearest first"
    assert wider[2].database_keyframes == (1,)
