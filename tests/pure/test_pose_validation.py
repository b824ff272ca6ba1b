"""The verdict on a pose: what is usual in a recording, what is doubtful, what is lost."""

from dataclasses import replace
from typing import Any

import pytest

from sigmasplat.fit.compare import NOTHING, Comparison
from sigmasplat.tracking.pose_validation import (
    PATIENCE,
    RECENT,
    TrackingStatistics,
    confirmed,
    explained,
    recognised,
    score,
    stands,
)

GOOD = Comparison(common=0.85, close=0.98, front=0.01, behind=0.01, residual=0.3, correlation=0.95)
FLAT = replace(GOOD, correlation=float("nan"))
OBJECT = replace(GOOD, close=0.5, front=0.49, behind=0.01)
"""Something large has moved into view."""
THROUGH = replace(GOOD, close=0.6, front=0.0, behind=0.4)
"""Known surfaces are seen through."""


def usual(c: Comparison = GOOD, times: int = 10) -> TrackingStatistics:
    history = TrackingStatistics()
    for _ in range(times):
        history.add(c)
    return history


def test_new_objects_are_not_counted_against_a_pose() -> None:
    assert explained(OBJECT) == pytest.approx(0.5 / 0.51) and explained(THROUGH) == pytest.approx(0.6)
    assert explained(NOTHING) == score(NOTHING) == 0.0
    assert score(THROUGH) < score(OBJECT) * 1.2 < score(GOOD)


@pytest.mark.parametrize("history", [TrackingStatistics(), usual()], ids=["first frame", "later"])
def test_a_good_pose_is_valid_without_doubt(history: TrackingStatistics) -> None:
    for c in (GOOD, FLAT):
        assert not history.is_lost(c, 0.2) and not history.doubts(c)


@pytest.mark.parametrize(
    "wrong",
    [{"close": 0.1, "front": 0.9}, {"close": 0.6, "behind": 0.4}, {"residual": 20.0}, {"correlation": 0.1},
     {"common": 0.1}],
    ids=["all in front", "seen through", "wrong depth", "other texture", "hardly any overlap"],
)  # fmt: skip
@pytest.mark.parametrize("history", [TrackingStatistics(), usual()], ids=["first frame", "later"])
def test_a_contradicted_pose_is_lost_and_doubted(history: TrackingStatistics, wrong: dict[str, Any]) -> None:
    c = replace(GOOD, **wrong)
    assert history.is_lost(c, 0.2) and history.doubts(c) and not confirmed(c)


def test_without_anything_in_common_a_pose_is_lost() -> None:
    assert usual().is_lost(NOTHING, 0.2) and usual().doubts(NOTHING) and not confirmed(NOTHING)


def test_an_object_in_front_is_doubted_but_not_lost() -> None:
    assert usual().doubts(OBJECT) and not usual().is_lost(OBJECT, 0.2)


def test_the_least_overlap_is_a_setting() -> None:
    some = replace(GOOD, common=0.3)
    assert usual().is_lost(some, 0.4) and not usual().is_lost(some, 0.2)


def test_a_noisy_recording_is_judged_by_its_own_usual_values() -> None:
    noisy = replace(GOOD, residual=1.5, correlation=0.6)
    assert usual(GOOD).doubts(noisy) and not usual(noisy).doubts(noisy)
    assert not usual(noisy).is_lost(replace(noisy, residual=7.0), 0.2)
    assert usual(GOOD).is_lost(replace(noisy, residual=7.0), 0.2)
    assert usual(noisy).is_lost(replace(noisy, correlation=0.2), 0.2)


def test_few_frames_do_not_define_what_is_usual() -> None:
    worse = replace(GOOD, common=0.5)
    assert usual(GOOD, 1).doubts(worse) == TrackingStatistics().doubts(worse)
    assert not usual(worse, 10).doubts(worse)


def test_a_camera_that_turns_from_the_start_is_not_doubted() -> None:
    turned = replace(GOOD, common=0.65)
    assert not TrackingStatistics().doubts(turned) and not usual(GOOD, 3).doubts(turned)
    assert TrackingStatistics().doubts(replace(turned, correlation=0.75))


def test_what_is_usual_follows_the_latest_frames() -> None:
    worse = replace(GOOD, common=0.4)
    history = usual(GOOD, 3 * RECENT)
    assert history.doubts(worse)
    for _ in range(RECENT):
        history.add(worse)
    assert not history.doubts(worse) and len(history.scores) == RECENT


def test_values_without_meaning_do_not_enter_what_is_usual() -> None:
    history = usual(replace(FLAT, residual=float("inf")), 20)
    assert history.residuals == history.correlations == [] and len(history.scores) == 20
    assert not history.doubts(GOOD)


def test_a_lost_camera_needs_more_than_a_tracked_one() -> None:
    """Without a prediction, a surface that fits in part is found in many places."""
    assert confirmed(GOOD) and confirmed(FLAT)
    for weak in (OBJECT, replace(GOOD, common=0.2), replace(GOOD, correlation=0.6), replace(GOOD, residual=3.0)):
        assert not confirmed(weak) and not usual().is_lost(weak, 0.1)


def test_texture_counts_in_the_score_where_there_is_texture() -> None:
    assert score(replace(GOOD, correlation=0.3)) < 0.5 * score(GOOD) < score(FLAT)
    assert score(replace(GOOD, correlation=-0.5)) == 0.0


def test_a_doubtful_pose_stands_only_after_some_others_and_if_the_surfaces_confirm_it() -> None:
    blurred = replace(GOOD, correlation=0.75)
    assert not confirmed(blurred)
    assert not stands(blurred, PATIENCE) and stands(blurred, PATIENCE + 1)
    for wrong in (THROUGH, OBJECT, NOTHING, replace(blurred, residual=5.0), replace(GOOD, correlation=0.5)):
        assert not stands(wrong, PATIENCE + 1)


def test_few_matches_need_surfaces_that_agree_better() -> None:
    likely = replace(GOOD, close=0.92, behind=0.07, correlation=0.94)
    assert recognised(GOOD, 9) and recognised(likely, 40)
    assert confirmed(likely) and not recognised(likely, 12)
    assert not recognised(replace(GOOD, correlation=0.84), 12)
    for wrong in (THROUGH, OBJECT, NOTHING):
        assert not recognised(wrong, 500)


def test_gray_values_that_agree_much_less_than_usual_show_that_the_pose_may_be_drawn() -> None:
    history = usual(replace(GOOD, correlation=0.98))
    assert history.agrees_less(replace(GOOD, correlation=0.89))  # not yet doubtful
    assert not history.doubts(replace(GOOD, correlation=0.89))
    assert not history.agrees_less(replace(GOOD, correlation=0.96))
    assert not history.agrees_less(None) and not history.agrees_less(FLAT)
