"""The rules of tracking/ and mapping/: each is a question with a known answer on either side of its bound."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sigmasplat.config import MappingConfig
from sigmasplat.fit.pose import PoseFit
from sigmasplat.mapping.window import draw_keyframes
from sigmasplat.tracking.keyframe_rule import is_held_back, is_keyframe
from sigmasplat.tracking.pose_validation import is_lost, jumped
from sigmasplat.types import never, unless

NAN = float("nan")


def fit(agreement: float, overlap: float) -> PoseFit:
    return PoseFit(np.eye(4), agreement, overlap, NAN, 0.0, 1)


def keyframe(since: int, overlap: float, moved_rad: float = 0.0, least_deg: float = 0.0, every: int = 5) -> bool:
    return is_keyframe(since, overlap, moved_rad, 1.0, MappingConfig(every=every, overlap_below=0.7), least_deg)


def test_a_keyframe_is_due_after_a_number_of_frames_or_at_low_overlap() -> None:
    due = {(4, 1.0): False, (5, 1.0): True, (6, 1.0): True, (1, 0.71): False, (1, 0.69): True, (1, 0.0): True}
    assert {case: keyframe(*case) for case in due} == due


def test_a_keyframe_is_due_when_the_view_has_moved_by_an_eighth_of_its_width() -> None:
    """A fast camera must not be tracked relative to a view of five frames ago."""
    assert keyframe(1, 1.0, 0.13) and not keyframe(1, 1.0, 0.12)


def test_a_live_camera_at_rest_makes_no_keyframes() -> None:
    still, moves = np.deg2rad([4.9, 5.1])
    assert not keyframe(100, 1.0, still, least_deg=5.0) and keyframe(5, 1.0, moves, least_deg=5.0)
    assert not keyframe(4, 1.0, moves, least_deg=5.0), "not more often than in a recording"
    assert keyframe(1, 0.69, still, least_deg=5.0), "unless the overlap is low"


def test_overlap_zero_switches_the_rules_of_views_off() -> None:
    papers = MappingConfig(every=5, overlap_below=0.0)
    assert not is_keyframe(1, 0.0, 0.9, 1.0, papers)
    assert is_keyframe(1, 1.0, 0.0, 1.0, replace(papers, every=1)), "every frame, as TUM's preset has it"


def test_the_last_of_each_n_frames_is_held_back() -> None:
    assert [index for index in range(24) if is_held_back(index, 8)] == [7, 15, 23]
    assert not any(is_held_back(index, 0) for index in range(24))


def test_a_pose_is_lost_by_disagreement_or_by_too_little_in_common() -> None:
    lost = {  # by (agreement, overlap)
        (0.95, 0.90): False,
        (0.59, 1.00): True,  # the surfaces in common disagree
        (0.61, 1.00): False,
        (0.99, 0.15): True,  # too few are in common
        (0.99, 0.25): False,
        (0.61, 0.30): True,  # both middling: their product counts
        (0.00, 0.00): True,
    }
    assert {case: is_lost(fit(*case), 0.6, 0.2) for case in lost} == lost


def test_a_first_loss_jumps_against_the_median_of_last_losses() -> None:
    assert jumped(5.1, [1.0], "longer") and not jumped(4.9, [1.0], "longer")
    assert jumped(50.1, [1.0], "odometry") and not jumped(49.9, [1.0], "odometry")
    assert jumped(5.1, [1.0, 1.0, 1.0, 900.0, 900.0], "longer"), "outliers do not move the median"
    assert not jumped(1e9, [], "longer"), "the first frame has nothing to be compared with"
    assert not jumped(1e9, [1.0] * 9, "off")
    assert not jumped(NAN, [1.0] * 9, "longer"), "aligning has no first loss: the rule is silent"


def shares(keyframes: int, newest_probability: float, draws: int = 20_000) -> dict[int, float]:
    drawn = draw_keyframes(range(keyframes), draws, newest_probability, np.random.default_rng(0))
    found = Counter(keyframe for (keyframe,) in drawn)
    return {keyframe: count / draws for keyframe, count in found.items()}


def test_the_newest_keyframe_is_drawn_with_its_probability_and_the_others_alike() -> None:
    found = shares(5, 0.4)
    expected = {4: 0.4} | dict.fromkeys(range(4), 0.15)
    assert set(found) == set(expected)
    for keyframe, share in expected.items():
        error = np.sqrt(share * (1 - share) / 20_000)
        assert abs(found[keyframe] - share) < 4 * error, f"keyframe {keyframe}: {found[keyframe]} for {share}"


def test_only_the_newest_is_drawn_if_it_is_alone_or_certain() -> None:
    for keyframes, probability in [(1, 0.0), (1, 0.4), (6, 1.0)]:
        assert shares(keyframes, probability, draws=200) == {keyframes - 1: 1.0}


def test_never_the_newest_at_probability_zero() -> None:
    assert set(shares(4, 0.0)) == {0, 1, 2}


def test_draws_follow_from_the_seed() -> None:
    def drawn(seed: int) -> list[int]:
        return list(draw_keyframes(range(7), 50, 0.4, np.random.default_rng(seed)))

    assert drawn(3) == drawn(3) != drawn(4)
    assert len(drawn(3)) == 50
    assert list(draw_keyframes(range(7), 0, 0.4, np.random.default_rng(0))) == []


def test_guesses_end_when_the_next_frame_waits() -> None:
    made = list[int]()

    def guesses() -> Iterator[int]:
        for number in range(5):
            made.append(number)
            yield number

    asked = iter([False, False, True])
    assert list(unless(lambda: next(asked), guesses())) == [0, 1] == made
    made.clear()
    assert list(unless(lambda: True, guesses())) == [] == made
    assert list(unless(never, range(3))) == [0, 1, 2]
