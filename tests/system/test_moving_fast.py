"""A fast camera over a desk, with motion blur: it is not where it was expected, but nothing moves in front of it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data.frame import Frame
from sigmasplat.plugins.sources import open_source
from sigmasplat.system.slam import Slam
from sigmasplat.tracking.moving.dynamic_mask import share_of

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

LITTLE = {"mapping.first_iterations": "10", "mapping.iterations": "4", "final.iterations": "0"}
LENGTH_PX = 15


def blurred(frame: Frame, random: np.random.Generator) -> Frame:
    """Return a frame whose colour is blurred along a line in a random direction."""
    kernel, middle, angle = np.zeros((LENGTH_PX, LENGTH_PX), np.float32), LENGTH_PX // 2, random.uniform(0.0, np.pi)
    ends = [np.rint(middle + side * middle * np.array([np.cos(angle), np.sin(angle)])).astype(int) for side in (-1, 1)]
    cv2.line(kernel, ends[0].tolist(), ends[1].tolist(), (1.0,))
    return replace(frame, color=np.asarray(cv2.filter2D(frame.color, -1, kernel / kernel.sum()), np.float32))


@pytest.mark.parametrize("seed", range(2))
def test_nothing_is_in_front(data_folder: Callable[[str], Path], seed: int) -> None:
    """With the expected pose in place of the found one, 0.92 of the image was taken for a thing that moves."""
    slam, random = Slam(override(preset("sigma"), LITTLE)), np.random.default_rng(seed)
    source, hidden = open_source(str(data_folder("fr1_xyz"))), []
    for index, number in enumerate(range(260, 290, 3)):
        slam.step(replace(blurred(source.frame(number), random), index=index))
        hidden.append(share_of(slam.tracker.front))
    assert {step.state for step in slam.steps} == {"tracked"}
    assert not any(hidden), hidden
