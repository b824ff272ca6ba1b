"""A fast camera over a desk, with motion blur: it is not where it was expected, but nothing moves in front of it."""

import importlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import benchmark_results  # noqa: F401 - finds the programs of the benchmarks
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data.frame import Frame
from sigmasplat.plugins.sources import open_source
from sigmasplat.system.slam import Slam

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

disturbances: Any = importlib.import_module("disturbances")
LITTLE = {"mapping.first_iterations": "10", "mapping.iterations": "4", "final.iterations": "0"}
LENGTH_PX = 15


def blurred(frame: Frame, random: np.random.Generator) -> Frame:
    """Return a frame whose colour is blurred along a line in a random direction, as that of robustness.py."""
    moment = disturbances.Moment(random, 0, 0, 0.0, float)
    return replace(frame, color=disturbances.blur(frame.color, frame.depth_m, LENGTH_PX, moment)[0])


@pytest.mark.parametrize("seed", range(2))
def test_nothing_is_in_front(data_folder: Callable[[str], Path], seed: int) -> None:
    """With the expected pose in place of the found one, 0.92 of the image was taken for a thing that moves."""
    slam, random = Slam(override(preset("sigma"), LITTLE)), np.random.default_rng(seed)
    source, hidden = open_source(str(data_folder("fr1_xyz"))), []
    for index, number in enumerate(range(260, 290, 3)):
        step = slam.step(replace(blurred(source.frame(number), random), index=index))
        hidden.append(step.tracking["moving"])
    assert {step.state for step in slam.steps} == {"tracked"}
    assert not any(hidden), hidden
