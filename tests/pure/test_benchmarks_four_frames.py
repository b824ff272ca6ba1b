"""The test of geometry on four frames: it scores the pixels that the frames have seen."""

import importlib
from typing import Any

import numpy as np
import pytest

from benchmark_results import laid_out
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.plugins.sources import open_source

four_frames = importlib.import_module("four_frames")
ROOM = "synthetic:frames=400,width=64,height=48"
FAST = ("mapping.iterations=4", "mapping.first_iterations=30")
OPTIONS = four_frames.Options(
    (ROOM,), settings=FAST, width=64, starts=(0,), spacing=2, views=6, every=3, steps=20, seeds=(3,)
)


def test_a_map_of_four_frames_is_scored_after_each_stage() -> None:
    figures = four_frames.measure(OPTIONS)
    (source,) = figures["sources"]
    (fit,) = source["fits"]
    assert (fit["start"], fit["seed"], fit["views"]) == (0, 3, 2)
    for stage in four_frames.STAGES:
        assert 0.0 < fit[stage]["depth_l1_m"] < 0.3 and fit[stage]["psnr_db"] > 12.0
        assert 0.5 < fit[stage]["covered"] <= 1.0 and fit[stage]["splats"] > 100
    made = laid_out("four_frames", figures, config={"steps": 20})["Four frames"]
    assert [row[1] for row in made.rows] == list(four_frames.STAGES)
    assert made.rows[0][2] == four_frames.spread([1e3 * fit["mapped"]["depth_l1_m"]])


def test_only_pixels_that_a_fitted_frame_has_seen_are_scored() -> None:
    config = OPTIONS.config(0)
    sequence = four_frames.TrueSequence(open_source(ROOM, config.input), config)
    depth_m = sequence.frame(0).depth_m
    assert np.array_equal(sequence.seen(0, [0]), depth_m > 0), "a frame has seen itself"
    half_turn = [i for i in range(0, 400, 20) if (sequence.pose(0)[:3, :3].T @ sequence.pose(i)[:3, :3])[2, 2] < -0.5]
    assert half_turn and not sequence.seen(0, half_turn[:1]).mean() > 0.3, "the other way it saw another wall"


@pytest.mark.parametrize(("options", "problem"), [
    ({"starts": (396,)}, SourceError), ({"preset": "sgma"}, ConfigError),
])  # fmt: skip
def test_what_cannot_be_measured_is_refused(options: dict[str, Any], problem: type[Exception]) -> None:
    with pytest.raises(problem):
        four_frames.measure(four_frames.Options(**(vars(OPTIONS) | options)))
