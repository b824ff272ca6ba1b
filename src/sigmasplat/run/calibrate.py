"""Measure a sensor from a whole recording: when it reads depth and rows, and what is wrong with the stated camera. The
run's own tracking finds pairs of keyframes, but no map is fitted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import stdtrit

from sigmasplat.config import Config
from sigmasplat.data.camera_errors import KNOWN_NONE, CameraErrors, corner_share
from sigmasplat.data.readout import SensorTimes
from sigmasplat.errors import SourceError
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.graph.graph_errors import CALIBRATION
from sigmasplat.graph.sensor_fit import LEVEL, NEIGHBOURS, TIMES, Fit, Pair, Parameters, fitted, read, times_of
from sigmasplat.input.source import Source
from sigmasplat.system.slam import Slam
from sigmasplat.tracking.moving.free_space import on_image
from sigmasplat.types import Matrix, Progress, completed, no_progress

WITHOUT_MAP: Mapping[str, Mapping[str, Any]] = {
    "input": {"calibrate": "off", "hold_every": 0, "crop_px": 0}, "mapping": {"iterations": 0, "first_iterations": 0},
    "seeding": {"max_splats": 1}, "recovery": {"relocalise": False}, "uncertainty": {"probes": 0},
}  # fmt: skip
"""Settings that align keyframes to each other, and do hardly anything else."""
MOST_PAIRS, CAMERA_PAIRS, CURVE_PAIRS = 240, 120, 60
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


@dataclass(frozen=True, eq=False)
class Measured:
    """What a recording shows of its sensor. times, camera: for runs, which are 0 if the measured ones may be, unknown
    if they are not clear; estimate: the measured times; costs [3, N, 2]: of some values of each time, s, with the
    others as measured, relative to the lowest cost."""

    times: SensorTimes
    camera: CameraErrors
    estimate: SensorTimes
    costs: Matrix


def measure_sensor(source: Source, config: Config, progress: Progress = no_progress) -> Measured:
    """Measure the sensor of a recording. Raises SourceError if the recording does not show when it reads."""
    pairs = aligned_pairs(source, config, progress)
    fit = completed(fitted(pairs, TIMES))
    camera = camera_errors(pairs, _times_beside_camera(pairs, fit))
    if any(camera.values):
        pairs = [_of_true(pair, camera) for pair in pairs]
        fit = completed(fitted(pairs, TIMES))
    estimate = times_of(fit)
    if estimate.std_s is None:
        raise SourceError(
            f"{source.name}: {len(pairs)} pairs of keyframes do not show clearly when the sensor reads; record half a "
            "minute in which the camera turns and shifts to and fro, before surfaces with edges"
        )
    return Measured(estimate if fit.sure else SensorTimes(std_s=estimate.std_s), camera, estimate, _costs(pairs, fit))


def _costs(pairs: Sequence[Pair], best: Fit) -> Matrix:
    ends = np.minimum(best.values, 0.0) - BESIDE_S, np.maximum(best.values, 0.0) + BESIDE_S
    seen = [found for pair in pairs if (found := pair.at(best.values, TIMES))]
    seen = seen[:: len(seen) // CURVE_PAIRS + 1]
    values_s, costs = np.linspace(*ends, CURVE_POINTS), np.empty((3, CURVE_POINTS))
    for k, i in np.ndindex(*costs.shape):
        times_s = np.where(np.arange(3) == k, values_s[i], best.values)
        costs[k, i] = np.mean([np.log((pair.at(times_s, TIMES) or pair).cost / pair.cost) for pair in seen])
    return np.stack([values_s.T, np.exp(costs)], -1)


# ---- the camera ----


def _true(image: Pyramid, errors: CameraErrors) -> Pyramid:
    """Return an image as the true camera sees it."""
    host, beside, cameras = image.kernels.to_host, image.kernels.beside, image.cameras
    gray, depth, color_depths = image.gray, image.depth, image.color_depths
    if errors.inverse_depth:
        depth = [beside(errors.depth(host(plane)), plane) for plane in depth]
        color_depths = {w: beside(errors.depth(host(seen)), seen) for w, seen in color_depths.items()}
    if errors.falloff:
        gray = [beside(errors.evened(host(g), c), g) for g, c in zip(gray, cameras, strict=True)]
    true = [errors.camera(c) for c in cameras]
    return replace(image, gray=gray, depth=depth, cameras=true, color_depths=color_depths)


def _of_true(pair: Pair, errors: CameraErrors) -> Pair:
    return pair._replace(reference=_true(pair.reference, errors), live=_true(pair.live, errors))


def _images(pair: Pair, values: Matrix) -> tuple[Pyramid, Pyramid]:
    true = _of_true(pair, CameraErrors(*values.tolist()))
    return true.reference, true.live


CAMERA = Parameters(np.array([0.01, 0.01, 0.01, 0.005]), _images)
"""Focal length and image centre as shares, and inverse depth, per metre: the first four of `CameraErrors`. One per cent
moves the border of a working image by 1 to 3 pixels."""
UNCLEAR = (CALIBRATION, CALIBRATION, CALIBRATION, 0.003)
"""Standard deviations of errors that the pairs do not show: those of a camera that nobody has checked."""
BOTH = Parameters(
    np.append(TIMES.units, CAMERA.units),
    lambda pair, v: TIMES.images(_of_true(pair, CameraErrors(*v[3:].tolist())), v[:3]),
)
"""Times and camera together."""


def _times_beside_camera(pairs: Sequence[Pair], alone: Fit) -> SensorTimes:
    """Return the times where times and camera together agree best, because they bias each other; those that were
    measured alone if both together are not clear."""
    if not alone.sure:
        return SensorTimes()
    even = CameraErrors(falloff=falloff_of(pairs, np.zeros(4))[0])
    some = [_of_true(pair, even) for pair in pairs[:: len(pairs) // CAMERA_PAIRS + 1]]
    both = completed(fitted(some, BOTH))
    return SensorTimes(*(both if both.sure else alone).values[:3].tolist(), std_s=(0.0,) * 3)


def camera_errors(pairs: Sequence[Pair], times: SensorTimes) -> CameraErrors:
    """Measure what is wrong with the stated camera; unknown with few pairs.

    Fall-off is measured first, because it biases the others, and once more at the end. Errors are used if they are sure
    (`sensor_fit`), and if those measured on each half of the pairs lower the cost of the other half: an error of
    another kind seldom does.
    """
    seen, values = list[Pair](), np.zeros(4)
    for pair in pairs[:: len(pairs) // CAMERA_PAIRS + 1]:
        reference, live = read(pair, times)
        if found := pair._replace(reference=reference, live=live).at(values, CAMERA):
            seen.append(found)
    if len(seen) < BLOCKS:
        return KNOWN_NONE
    even = CameraErrors(falloff=falloff_of(seen, values)[0])
    bright = [_of_true(pair, even) for pair in seen]
    fit = completed(fitted(bright, CAMERA))
    halves = [[pair for pair in bright if pair.number // NEIGHBOURS % 2 == half] for half in (0, 1)]
    used = fit.sure and all(_helps(completed(fitted(a, CAMERA)), b) for a, b in (halves, halves[::-1]))
    values = fit.values if used else values
    falloff, std = falloff_of([found for pair in seen if (found := pair.at(values, CAMERA))], values)
    others = UNCLEAR if fit.std is None or fit.sure > used else fit.std.tolist()
    return CameraErrors(*np.append(values, falloff).tolist(), std=(*others, std))


def _helps(fit: Fit, others: Sequence[Pair]) -> bool:
    """Return whether other pairs agree better at the values of a fit than at 0."""
    costs = [(pair.at(np.zeros(4), CAMERA), pair.at(fit.values, CAMERA)) for pair in others]
    return float(np.sum([np.log(after.cost / before.cost) for before, after in costs if before and after])) < 0.0


# ---- the fall-off of light towards the corners ----

SAMPLES, DARK, BRIGHT, GRAY_STEP = 1000, 0.05, 0.95, 1 / 255
"""Points of a pair, about; darker ones are mostly noise, brighter ones may be saturated; one step of gray is the
systematic error of the fall-off."""
SAME = 0.05
"""Two points are the same if their depths differ by less than this share."""
BLOCKS = 8
"""The spread of so many parts of a recording is the error of the fall-off."""


def falloff_of(pairs: Sequence[Pair], values: Matrix) -> tuple[float, float]:
    """Return the share by which corners are darker, 0 if it is not sure, and its standard deviation; values [4]: the
    other errors of the camera.

    The same point has another gray where it is nearer to a corner, apart from a gain of each image. The sum of absolute
    differences of log gray is minimised, which ignores reflections and edges.
    """
    seen = [_same_points(pair, values) for pair in pairs]

    def cost(falloff: float, some: Sequence[Matrix]) -> float:
        return sum(_spread(d - np.log1p(-falloff * b) + np.log1p(-falloff * a)) for d, a, b in some)

    def best(some: Sequence[Matrix]) -> float:
        return float(minimize_scalar(cost, bounds=(-0.5, 0.9), args=(some,), method="bounded").x)

    parts = [best([seen[i] for i in part]) for part in np.array_split(np.arange(len(seen)), BLOCKS)]
    found, std = best(seen), float(np.hypot(np.std(parts, ddof=1) / BLOCKS**0.5, GRAY_STEP))
    return (found if abs(found) > std * stdtrit(BLOCKS - 1, (1.0 + LEVEL) / 2.0) else 0.0), std


def _spread(differences: Matrix) -> float:
    return float(np.abs(differences - np.median(differences)).sum()) if len(differences) else 0.0


def _same_points(pair: Pair, values: Matrix) -> Matrix:
    """Return of points that both images show [3, P]: log gray in the live image minus that in the reference, and
    `corner_share` in the reference and in the live image."""
    reference, live = _images(pair, values)
    c, host = reference.cameras[0], reference.kernels.to_host
    gray, depth_m, live_gray, live_m = (host(p[0]) for p in (reference.gray, reference.depth, live.gray, live.depth))
    step = max(1, int((c.width * c.height / SAMPLES) ** 0.5))
    v, u = (step * k for k in np.nonzero(depth_m[::step, ::step]))
    z = depth_m[v, u]
    there = pair.T_live_reference @ np.stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z, np.ones_like(z)])
    inside, y, x = on_image(there[0], there[1], there[2], c)
    u, v, x, y, ahead = (values[inside] for values in (u, v, x, y, there[2]))
    grays = np.stack([gray[v, u], live_gray[y, x]])
    known = (np.abs(live_m[y, x] - ahead) < SAME * ahead) & (grays.min(0) > DARK) & (grays.max(0) < BRIGHT)
    before, after = np.log(grays[:, known])
    shares = (corner_share(a[known], b[known], c) for a, b in ((u, v), (x, y)))
    return np.stack([after - before, *shares]).astype(np.float64)
