"""The probability that a pose is wrong: which evidence raises it, and how doubts add up from keyframe to keyframe."""

import math

import pytest

from sigmasplat.data.trajectory import APART, LOST, TRACKED
from sigmasplat.graph.confidence import Confidence, off_probability
from sigmasplat.tracking.pose_validation import DOUBTFUL

CLEAN: dict[str, float] = {
    "common": 0.9, "close": 0.98, "front": 0.01, "behind": 0.01, "residual": 0.3, "correlation": 0.97, "points": 3000.0,
    "moved": 0.01,
}  # fmt: skip


def probability(state: str = TRACKED, **changes: float) -> float:
    return off_probability(state, CLEAN | changes)


def test_lost_frames_and_frames_without_a_place_in_the_world_are_almost_surely_off() -> None:
    assert probability() < 0.1 < 0.8 < probability(LOST) <= 1.0 and 0.9 < probability(APART) <= 1.0


@pytest.mark.parametrize(
    "worse",
    [{"doubt": 0.1}, {"behind": 0.3}, {"close": 0.6, "front": 0.39}, {"correlation": 0.5}, {"moved": 0.3}],
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
    assert 0.0 <= off_probability(TRACKED, values) <= 1.0


def test_a_wrong_fit_or_a_wrong_place_alone_puts_a_frame_off() -> None:
    wrong = {"behind": 0.4, "close": 0.5, "correlation": 0.2, "moved": 0.5}
    assert probability(**wrong) > 0.95
    assert probability(doubt=0.8) > 0.7
    assert probability(**wrong, doubt=0.8) > max(probability(**wrong), probability(doubt=0.8))


def chain(*hops: float) -> Confidence:
    """Keyframes in a row, of which only hops tell where they are."""
    c = Confidence()
    for number, wrong in enumerate(hops):
        c.placed(number, wrong, [])
    return c


def test_doubts_of_hops_add_up_and_other_hops_add_none() -> None:
    assert chain(0.0, *[0.8 * DOUBTFUL] * 1000).newest == 0.0
    assert chain(0.0, 0.2).newest == pytest.approx(0.2)
    assert chain(0.0, 0.2, 0.0, 0.3).newest == pytest.approx(1.0 - 0.8 * 0.7)
    assert probability(doubt=chain(0.0, *[0.4] * 3).newest) > 0.7


def test_an_alignment_to_an_earlier_keyframe_confirms_the_place() -> None:
    c = chain(0.0, 0.2, 0.4, 0.4)
    c.placed(4, 0.4, [3])
    assert c.newest == pytest.approx(1.0 - 0.8 * 0.6**2), "no better than the place that it is aligned to"
    c.placed(5, 0.4, [1, 4])
    assert c.newest == pytest.approx(0.2)
    c.placed(5, 0.0, [])  # mapped again
    assert len(c.doubts) == 6


def test_a_camera_that_was_found_again_is_as_sure_as_that_place() -> None:
    c = chain(0.0, 0.2, 0.4)
    c.begins(1)
    c.placed(3, 0.0, [])
    assert c.newest == pytest.approx(0.2)
    c.begins()
    c.placed(4, 0.0, [])
    assert c.newest == 0.0, "a component begins at its own origin"
    earlier = Confidence()
    earlier.begins(7)  # a keyframe of a map that was finished before
    earlier.placed(9, 0.0, [])
    assert earlier.newest == 0.0 and len(earlier.doubts) == 10
