"""The probability that a pose is wrong: which evidence raises it, and how the spread of positions accumulates."""

import math
from typing import Any

import numpy as np
import pytest

from sigmasplat.data.trajectory import APART, LOST, TRACKED
from sigmasplat.graph.confidence import Confidence, std_of
from sigmasplat.graph.loops import Loop

CLEAN: dict[str, float] = {
    "common": 0.9, "close": 0.98, "front": 0.01, "behind": 0.01, "residual": 0.3, "correlation": 0.97, "points": 3000.0,
    "position_std_m": 0.005, "moved": 0.01,
}  # fmt: skip


def probability(state: str = TRACKED, **changes: float) -> float:
    return Confidence([0.0]).probability(state, CLEAN | changes)


def test_lost_frames_and_frames_without_a_place_in_the_world_are_almost_surely_off() -> None:
    assert probability() < 0.1 < 0.8 < probability(LOST) <= 1.0 and 0.9 < probability(APART) <= 1.0


@pytest.mark.parametrize(
    "worse",
    [{"position_std_m": 0.1}, {"behind": 0.3}, {"close": 0.6, "front": 0.39}, {"correlation": 0.5}, {"moved": 0.3}],
    ids=lambda changes: next(iter(changes)),
)  # fmt: skip
def test_each_kind_of_evidence_raises_the_probability(worse: dict[str, float]) -> None:
    assert probability(**worse) > probability()


@pytest.mark.parametrize(
    "values",
    [{}, {"agreement": 0.9, "overlap": 0.9}, CLEAN | {"correlation": math.nan}, CLEAN | {"residual": math.inf},
     CLEAN | {"residual": math.nan}, CLEAN | {"close": 0.0, "behind": 0.0, "points": 0.0}],
    ids=["first frame", "without comparison", "flat image", "no residual", "undefined residual", "nothing in common"],
)  # fmt: skip
def test_missing_values_still_give_a_probability(values: dict[str, float]) -> None:
    assert 0.0 <= Confidence([0.0]).probability(TRACKED, values) <= 1.0


def test_a_wrong_fit_or_a_wrong_place_alone_puts_a_frame_off() -> None:
    wrong = {"behind": 0.4, "close": 0.5, "correlation": 0.2, "moved": 0.5}
    assert probability(**wrong) > 0.95
    assert probability(position_std_m=100.0) > 0.7
    assert probability(**wrong, position_std_m=100.0) > max(probability(**wrong), probability(position_std_m=100.0))


def loop(query: int, database: int, accepted: bool) -> Loop:
    nothing: dict[str, Any] = {name: 0 for name in Loop.__dataclass_fields__}
    return Loop(**nothing | {"query": query, "database": database, "accepted": accepted})


def test_spread_grows_along_the_path_and_shrinks_with_an_accepted_loop() -> None:
    c = Confidence()
    c.begun(None, 0.0)
    for parent in range(3):
        c.begun(parent, 0.1)
    assert c.position_std_m(0.0) == pytest.approx(0.1 * math.sqrt(3))
    assert c.position_std_m(0.3) == pytest.approx(math.hypot(0.3, 0.1 * math.sqrt(3)))
    c.closed([loop(3, 0, accepted=False)])
    assert c.position_std_m(0.0) == pytest.approx(0.1 * math.sqrt(3))
    c.closed([loop(3, 0, accepted=True)])
    assert 0.0 < c.position_std_m(0.0) < 0.05


def test_a_component_begins_at_its_own_origin_and_joins_with_the_spread_of_the_path_to_it() -> None:
    c = Confidence()
    for parent, std_m in ((None, 0.0), (0, 0.3), (None, 0.0), (2, 0.1)):
        c.begun(parent, std_m)
    assert c.position_std_m(0.0) == pytest.approx(0.1)
    c.joined([2, 3], submap=3, kept=1, link_m=0.02)
    assert min(c.spread_m[2:]) >= math.hypot(0.3, 0.02) and c.spread_m[:2] == [0.0, pytest.approx(0.3)]


def test_the_spread_of_an_information_matrix_is_that_of_its_position() -> None:
    deviations = np.array([0.03, 0.04, 0.12, 1.0, 1.0, 1.0])
    assert std_of(np.diag(deviations**-2)) == pytest.approx(0.13)
