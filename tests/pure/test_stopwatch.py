"""The stopwatch adds up seconds by stage."""

import pytest

from sigmasplat.types import Stopwatch


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Stopwatch:
    """A stopwatch whose clock advances by one second each time it is read."""
    seconds = iter(range(100))
    monkeypatch.setattr("time.perf_counter", lambda: float(next(seconds)))
    return Stopwatch()


def test_a_stage_adds_up_over_its_blocks(watch: Stopwatch) -> None:
    for _ in range(3):
        with watch.stage("forward"):
            pass
    assert watch.seconds == {"forward": 3.0}


def test_an_outer_stage_counts_the_inner_one_too(watch: Stopwatch) -> None:
    with watch.stage("outer"), watch.stage("inner"):
        pass
    assert watch.seconds == {"inner": 1.0, "outer": 3.0}


def test_a_stage_that_raises_is_counted(watch: Stopwatch) -> None:
    with pytest.raises(ValueError), watch.stage("loss"):
        raise ValueError
    assert watch.seconds == {"loss": 1.0}


def test_seconds_measured_elsewhere_are_added_under_a_prefix(watch: Stopwatch) -> None:
    watch.add({"forward": 0.5}, prefix="map_")
    watch.add({"forward": 0.25}, prefix="map_")
    assert watch.seconds == {"map_forward": 0.75}
