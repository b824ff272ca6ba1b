"""The verdict on a pose by the probability that it is wrong, and the noise of depth that only two images show."""

import math
from dataclasses import replace
from typing import Any

import pytest

from sigmasplat.fit.compare import NOTHING, Comparison
from sigmasplat.tracking.pose_validation import (
    DOUBTFUL,
    FEW,
    FEW_MATCHES,
    LOST,
    MEDIAN_NORMAL,
    RECENT,
    SURE,
    TrackingStatistics,
    confirmed,
    diagnosis,
    p_wrong,
    recognised,
)

GOOD = Comparison(common=0.85, close=0.98, front=0.01, behind=0.01, residual=0.3, correlation=0.97, moved=0.01)
FLAT = replace(GOOD, correlation=float("nan"))
OBJECT = replace(GOOD, close=0.5, front=0.49, behind=0.01)
"""Something large has moved into view."""
THROUGH = replace(GOOD, close=0.6, front=0.0, behind=0.4, correlation=0.5)
"""Known surfaces are seen through."""
BLURRED = replace(GOOD, correlation=0.75, moved=0.05)


def usual(c: Comparison = GOOD, times: int = 10) -> TrackingStatistics:
    history = TrackingStatistics()
    for _ in range(times):
        history.add(c)
    return history


def test_a_good_pose_is_sure_also_without_texture_or_behind_an_object() -> None:
    assert p_wrong(GOOD) < SURE / 5
    for c in (FLAT, OBJECT, replace(GOOD, correlation=0.9)):
        assert p_wrong(GOOD) < p_wrong(c) < DOUBTFUL


def test_a_bare_wall_does_not_confirm_a_pose() -> None:
    """Without texture, and with depth that agrees as well at any place along the wall."""
    for moved in (0.0, 0.05, 0.2):
        assert p_wrong(replace(FLAT, held=0.02, moved=moved)) > DOUBTFUL
    assert p_wrong(replace(FLAT, held=0.02, moved=0.3)) > LOST


def test_what_is_seen_through_or_shares_nothing_is_wrong() -> None:
    for c in (THROUGH, NOTHING, replace(GOOD, correlation=0.1, moved=0.3)):
        assert p_wrong(c) > LOST and not confirmed(c) and not recognised(c, 500)
    assert p_wrong(NOTHING) == 1.0


@pytest.mark.parametrize(
    ("name", "change"),
    [("behind", 0.1), ("correlation", -0.2), ("moved", 0.2), ("close", -0.3), ("held", -0.2)],
)
@pytest.mark.parametrize("c", [GOOD, BLURRED, THROUGH], ids=["good", "blurred", "wrong"])
def test_every_quantity_that_is_worse_makes_the_pose_less_sure(c: Comparison, name: str, change: float) -> None:
    worse: dict[str, Any] = {name: getattr(c, name) + change}
    assert p_wrong(replace(c, **worse)) > p_wrong(c)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, "90% of the image supports the pose"),
        ({"behind": 0.5, "close": 0.5, "correlation": 0.85}, "known surfaces are seen through on 50% of it"),
        ({"correlation": 0.1, "moved": 0.2}, "gray correlates by 0.10"),
        ({"correlation": math.nan, "behind": 0.02, "moved": 0.4}, "the images have no texture"),
        ({"correlation": 0.7, "moved": 1.0}, "it is off from the expected one by 100% of the depth"),
        ({"residual": math.inf}, "the images have next to nothing in common"),
    ],
)
def test_the_diagnosis_names_what_speaks_most_against_a_pose(change: dict[str, Any], said: str) -> None:
    c = replace(GOOD, **({"common": 0.9, "covered": 0.95, "close": 1.0, "front": 0.0, "behind": 0.0} | change))
    assert said in diagnosis(c) and (", but " in diagnosis(c)) == (DOUBTFUL < p_wrong(c) < 1.0)


def test_few_matches_need_images_that_agree_better() -> None:
    likely = replace(GOOD, correlation=0.9)
    assert SURE / 3 < p_wrong(likely) < SURE
    assert recognised(likely, FEW_MATCHES) and not recognised(likely, FEW_MATCHES - 1)
    assert recognised(GOOD, 8)


def test_noise_is_what_half_of_the_differences_exceed() -> None:
    assert TrackingStatistics().noise == usual(GOOD).noise == 1.0
    noisy = usual(replace(GOOD, residual=2.0 * MEDIAN_NORMAL), 1)
    assert noisy.noise == pytest.approx(2.0)
    for _ in range(RECENT):  # compared with twice the noise, it is as usual
        noisy.add(replace(GOOD, residual=MEDIAN_NORMAL))
    assert noisy.noise == pytest.approx(2.0) and len(noisy.residuals) == RECENT


def test_one_of_the_first_frames_shows_the_noise_if_gray_values_confirm_its_pose() -> None:
    noisy = replace(GOOD, close=0.6, front=0.2, behind=0.2, residual=3.0 * MEDIAN_NORMAL)
    history = TrackingStatistics()
    assert not history.learns_noise(None) and not history.learns_noise(GOOD)
    assert not history.learns_noise(replace(noisy, correlation=0.8)) and history.noise == 1.0
    assert history.learns_noise(noisy) and history.noise == pytest.approx(3.0)
    assert not usual(GOOD, FEW).learns_noise(noisy)


def test_values_without_meaning_do_not_enter_what_is_usual() -> None:
    history = usual(replace(FLAT, residual=float("inf")), 20)
    assert history.residuals == [] and history.noise == 1.0
