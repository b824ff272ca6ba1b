"""Depth whose noise neighbouring pixels share, as that of stereo cameras: no single image shows it."""

import importlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import benchmark_results  # noqa: F401 - finds the programs of the benchmarks
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data.frame import Frame
from sigmasplat.plugins.evaluation.metrics.trajectory import ate
from sigmasplat.plugins.sources import open_source
from sigmasplat.system.slam import Slam

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

disturbances: Any = importlib.import_module("disturbances")
LITTLE = {"mapping.first_iterations": "20", "mapping.iterations": "4", "final.iterations": "0"}
STD_PER_M = 0.012


def noisy(frame: Frame, random: np.random.Generator) -> Frame:
    """Return a frame with noise of `STD_PER_M` z² that patches of pixels share, and holes, as that of robustness.py."""
    moment = disturbances.Moment(random, 0, 0, 0.0, float)
    return replace(frame, depth_m=disturbances.shared_noise(frame.color, frame.depth_m, STD_PER_M, moment)[1])


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_noise_is_measured_and_no_frame_is_lost(seed: int) -> None:
    source, random = open_source(f"synthetic:frames=120,seed={seed}", limit=45), np.random.default_rng(seed)
    slam = Slam(override(preset("sigma"), LITTLE))
    for frame in source:
        slam.step(noisy(frame, random))
    assert {step.state for step in slam.steps} == {"tracked"}
    assert not slam.tracker.doubtful
    law = slam.config.render.depth_noise_per_m
    assert 0.5 * STD_PER_M < law * slam.tracker.statistics.noise < 1.5 * STD_PER_M
    truth = source.truth()
    assert truth is not None
    slam.finish()
    assert ate(slam.trajectory(), truth).rmse_m < 0.03


def test_a_sensor_that_keeps_to_its_law_changes_nothing() -> None:
    source, slam = open_source("synthetic:frames=120,noise=1", limit=20), Slam(override(preset("sigma"), LITTLE))
    for frame in source:
        slam.step(frame)
    assert slam.tracker.statistics.noise == 1.0
