"""benchmarks/composites.py: masks are scored at their own size."""

import importlib

import numpy as np

import benchmark_results  # noqa: F401, finds the benchmarks

composites = importlib.import_module("composites")
moving = importlib.import_module("moving")


class Ball:
    """A source whose ball covers the left half of an image of 4×8 pixels."""

    radius_m = 0.2

    def moving_of(self, i: int) -> np.ndarray:
        return np.arange(8)[None, :].repeat(4, 0) < 4


def test_masks_of_any_size_are_scored() -> None:
    """The first frame has a mask of the camera's size, a frame with something in front one of the working size."""
    half = np.array([[True, False, False, False], [True, True, False, True]])
    run = moving.Followed(None, [np.zeros((4, 8), np.bool_), half], 0.0)
    found = composites.masks_of(run, Ball())
    assert found["iou"] == 3 / (16 + 4 + 1)
    assert found["masked_wrongly_pct"] == 100 * 1 / (16 + 4)


def test_without_a_ball_there_is_no_overlap() -> None:
    ball = Ball()
    ball.radius_m = 0.0
    assert composites.masks_of(moving.Followed(None, [np.zeros((2, 4), np.bool_)], 0.0), ball)["iou"] is None
