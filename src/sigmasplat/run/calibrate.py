"""Measure when a sensor reads depth and rows, from a whole recording: the run's own tracking, but no map is fitted."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sigmasplat.config import Config
from sigmasplat.data.readout import SensorTimes
from sigmasplat.errors import SourceError
from sigmasplat.graph.sensor_times import Pair, estimated
from sigmasplat.input.source import Source
from sigmasplat.system.slam import Slam
from sigmasplat.types import Matrix, Progress, completed, no_progress

WITHOUT_MAP: Mapping[str, Mapping[str, Any]] = {
    "input": {"calibrate": "off", "hold_every": 0}, "mapping": {"iterations": 0, "first_iterations": 0},
    "seeding": {"max_splats": 1}, "recovery": {"relocalise": False}, "uncertainty": {"probes": 0},
}  # fmt: skip
"""Settings that align keyframes to each other, and do hardly anything else."""
MOST_PAIRS, CURVE_PAIRS = 240, 60
CURVE_POINTS, BESIDE_S = 13, 0.01
"""Points of a curve, which goes so far beyond 0 and the measured time."""


def aligned_pairs(source: Source, config: Config, progress: Progress = no_progress) -> list[Pair]:
    """Return pairs of keyframes of a recording that see the same."""
    slam = Slam(config.changed(**WITHOUT_MAP))
    for done, frame in enumerate(source.frames_from(0), 1):
        slam.step(frame)
        progress(done, len(source))
    if slam.steps:
        completed(slam.finish_submap())
    slam.correct_motions()
    return slam.graph.pairs(slam.keyframe_image, slam.atlas.readings.__getitem__, MOST_PAIRS)


def measure_times(
    source: Source, config: Config, progress: Progress = no_progress
) -> tuple[SensorTimes, SensorTimes, Matrix]:
    """Measure the times of a recording's sensor. Raises SourceError if the recording does not show them.

    Returns those for runs, which are 0 if the measured ones may be; the measured ones; and costs [3, N, 2]: of some
    values of each time, s, with the others as measured, relative to the lowest cost.
    """
    pairs = aligned_pairs(source, config, progress)
    estimate, sure = completed(estimated(pairs))
    if estimate.std_s is None:
        raise SourceError(
            f"{source.name}: {len(pairs)} pairs of keyframes do not show clearly when the sensor reads; record half a "
            "minute in which the camera turns and shifts to and fro, before surfaces with edges"
        )
    return estimate if sure else SensorTimes(std_s=estimate.std_s), estimate, _costs(pairs, estimate)


def _costs(pairs: Sequence[Pair], best: SensorTimes) -> Matrix:
    best_s = np.array([best.depth_late_s, best.depth_rows_s, best.color_rows_s])
    seen = [found for pair in pairs if (found := pair.at(best_s))]
    ends = np.minimum(best_s, 0.0) - BESIDE_S, np.maximum(best_s, 0.0) + BESIDE_S
    seen = seen[:: len(seen) // CURVE_PAIRS + 1]
    values_s, costs = np.linspace(*ends, CURVE_POINTS), np.empty((3, CURVE_POINTS))
    for k, i in np.ndindex(*costs.shape):
        times_s = np.where(np.arange(3) == k, values_s[i], best_s)
        costs[k, i] = np.mean([np.log((pair.at(times_s) or pair).cost / pair.cost) for pair in seen])
    return np.stack([values_s.T, np.exp(costs)], -1)
