"""Images whose rows are read late: alignment, comparison, rewriting them, and measuring when they are read."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

import row_times
from late_images import CAMERA, cast, frame, image
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.data.readout import AT_ONCE, UNKNOWN_TIMES, Readout, SensorTimes, read_at_once, readouts
from sigmasplat.fit.align import Alignment, Pair as Aligned, align, normal_equations
from sigmasplat.fit.compare import compare
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.graph.sensor_fit import (
    BIAS,
    LEAST_PAIRS,
    NEIGHBOURS,
    TIMES as THREE,
    Pair,
    Term,
    fitted,
    measured,
    newton_step,
)
from sigmasplat.types import completed

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

Array = NDArray[np.float64]
STD_S = (1e-3, 1e-3, 1e-3)
HERE, MOTION = np.eye(4), se3.exp(np.array([0.05, -0.03, 0.04, 0.02, -0.03, 0.02]))
THERE = se3.inverse(MOTION)
"""Poses of the reference and of the live camera in the world; MOTION is T_live_reference."""
GUESS = MOTION @ se3.exp(np.full(6, 0.003))
SHIFTING, TURNING = np.array([0.5, -0.4, 0.3, 0, 0, 0]), np.array([0, 0, 0, 0.5, -0.4, 0.5])
RATES = {"shifting": SHIFTING, "turning": TURNING, "both": SHIFTING + TURNING}
LATE, DEPTH_ROWS, COLOR_ROWS = ((0.02, 0.0, 0.0), (0.0, 0.03, 0.0), (0.0, 0.0, 0.03))
TIMES = {"late": LATE, "depth rows": DEPTH_ROWS, "colour rows": COLOR_ROWS, "all": (0.02, 0.03, 0.03)}


def readout(rate: Array, times_s: Sequence[float]) -> Readout:
    late_s, depth_s, color_s = times_s
    return Readout(rate, 0.0, SensorTimes(late_s, depth_s, color_s, std_s=STD_S))


def times_of(found: SensorTimes) -> Array:
    return np.array([found.depth_late_s, found.depth_rows_s, found.color_rows_s])


def spread(std_s: Array) -> Array:
    """Return the part of stated deviations [3] that the pairs themselves show, without the systematic error."""
    return np.asarray(np.sqrt(std_s**2 - (BIAS * THREE.units) ** 2))


def error_mm(found: Alignment, motion: Array = MOTION) -> float:
    """Return by how much the points of the scene are moved to the wrong place (root mean square)."""
    points = cast(np.repeat(HERE[None], CAMERA.height, 0))[0].reshape(-1, 3)[::7].T
    wrong = (found.T_live_reference - motion)[:3]
    return float(1e3 * np.sqrt(((wrong[:, :3] @ points + wrong[:, 3:]) ** 2).sum(0).mean()))


def two(reference: Readout, live: Readout) -> tuple[Pyramid, Pyramid]:
    return image(HERE, reference), image(THERE, live)


@pytest.mark.parametrize("times_s", TIMES.values(), ids=TIMES)
@pytest.mark.parametrize("rate", RATES.values(), ids=RATES)
@pytest.mark.parametrize("signs", [(1, 0), (0, 1), (1, -1)], ids=["reference", "live", "against each other"])
def test_known_times_undo_the_error_of_a_moving_camera(
    times_s: Sequence[float], rate: Array, signs: tuple[int, int]
) -> None:
    """A wrong sign, half of a time or twice as much would leave half of the error or more."""
    of_both = [readout(sign * rate, times_s) for sign in signs]
    images = two(*of_both)
    ignored = align(*images, GUESS, update_stop=2e-5)
    known = align(*(one.read(late) for one, late in zip(images, of_both, strict=True)), GUESS, update_stop=2e-5)
    assert error_mm(ignored) > 1.2 and error_mm(known) < min(1.2, 0.08 * error_mm(ignored))
    assert known.cost < 0.05 * ignored.cost
    assert known.overlap == pytest.approx(ignored.overlap, abs=0.05) and known.agreement > 0.99


@pytest.mark.parametrize("times_s", TIMES.values(), ids=TIMES)
def test_known_times_undo_the_error_of_a_fast_camera_that_has_come_far(times_s: Sequence[float]) -> None:
    """Between depth and colour it turns by 2°: depth of a pixel is not that of its colour, and motion is not linear."""
    motion = se3.exp(np.array([0.15, -0.1, 0.06, 0.03, -0.05, 0.03]))
    of_both = [readout(3 * RATES["both"] * change, times_s) for change in (np.ones(6), [1, 1, 1, 0.9, 1.1, 1])]
    reference, live = image(HERE, of_both[0]).read(of_both[0]), image(se3.inverse(motion), of_both[1]).read(of_both[1])
    assert error_mm(align(reference, live, motion, update_stop=2e-5), motion) < 0.7
    assert compare(reference, live, motion).correlation > 0.9989


@pytest.mark.parametrize("turned", [0.15, -0.15])
@pytest.mark.parametrize("times_s", TIMES.values(), ids=TIMES)
def test_the_overlap_of_late_images_is_that_of_the_cameras(times_s: Sequence[float], turned: float) -> None:
    """Gray and depth of a pixel leave the image at different places; a pixel counts if both are seen."""
    T = se3.exp(np.array([0, 0, 0, 0.6 * turned, turned, 0]))
    still = align(image(HERE), image(se3.inverse(T)), T, 0)
    late = readout(3 * TURNING, times_s)
    known = align(image(HERE, late).read(late), image(se3.inverse(T)), T, 0)
    assert 0.5 < still.overlap < 0.9 and known.overlap == pytest.approx(still.overlap, abs=0.06)


def test_a_camera_at_rest_and_one_that_reads_at_once_are_as_without_times() -> None:
    reference, live = image(HERE), image(THERE)
    plain, seen = align(reference, live, GUESS), compare(reference, live, MOTION)
    (linear,) = normal_equations(reference.kernels, Aligned(reference, live, 0.5).level(0), [GUESS])
    for late in (AT_ONCE, readout(np.zeros(6), TIMES["all"]), readout(RATES["both"], (0.0, 0.0, 0.0))):
        late_reference = reference.read(late)
        same = align(late_reference, live, GUESS)
        np.testing.assert_allclose(same.T_live_reference, plain.T_live_reference, atol=1e-6)
        np.testing.assert_allclose(
            [same.cost, same.overlap, same.agreement], [plain.cost, plain.overlap, plain.agreement], rtol=1e-5
        )
        assert (same.steps, same.degenerate) == (plain.steps, plain.degenerate)
        (timed,) = normal_equations(reference.kernels, Aligned(late_reference, live, 0.5).level(0), [GUESS])
        for name in ("H", "b", "S", "sums"):
            want = getattr(linear, name)
            np.testing.assert_allclose(getattr(timed, name), want, atol=1e-6 * np.abs(want).max())
        np.testing.assert_allclose(
            [getattr(compare(late_reference, live, MOTION), name) for name in seen.__annotations__],
            [getattr(seen, name) for name in seen.__annotations__], rtol=1e-9,
        )  # fmt: skip


def test_at_the_true_motion_late_images_look_alike_if_their_times_are_known() -> None:
    of_both = [readout(sign * RATES["both"], TIMES["all"]) for sign in (1.5, -1.5)]
    images = two(*of_both)
    ignored = compare(*images, MOTION)
    known = compare(*(one.read(late) for one, late in zip(images, of_both, strict=True)), MOTION)
    opposite = [readout(-late.rate, TIMES["all"]) for late in of_both]
    wrong = compare(*(one.read(late) for one, late in zip(images, opposite, strict=True)), MOTION)
    assert wrong.close < ignored.close < 0.95 and known.close > 0.99
    assert wrong.correlation < ignored.correlation < 0.98 and known.correlation > 0.99
    assert known.residual < 0.15 * ignored.residual


def test_only_known_times_of_a_moving_camera_matter() -> None:
    times = SensorTimes(0.01, 0.02, 0.03, std_s=STD_S)
    assert UNKNOWN_TIMES.read(Readout(SHIFTING)) is None and times.read(Readout(np.zeros(6))) is None
    late = times.read(Readout(SHIFTING, 0.005))
    assert late is not None
    np.testing.assert_allclose(late.numbers, [*SHIFTING, 0.015, 0.02, 0.03])
    rows, middles = np.array([0, 59.5, 119]), 119 / 240 * np.array([-1, 0, 1])
    np.testing.assert_allclose(row_times.depth_s(late, rows, 120), 0.015 + 0.02 * middles)
    np.testing.assert_allclose(row_times.color_s(late, rows, 120), 0.03 * middles)
    assert readouts(None, None) == [] and readouts(late, None) == [*late.numbers, *[0.0] * 9]
    assert readouts(None, late) == [*[0.0] * 9, *late.numbers]


INNER = np.s_[8:-8, 8:-8]


def apart(one: Frame, other: Frame, share: float) -> tuple[float, float]:
    """Return a quantile of the differences of depth, mm, and of colour, away from the borders of the image."""
    depth, color = (np.abs(a - b)[INNER] for a, b in ((one.depth_m, other.depth_m), (one.color, other.color)))
    return float(1e3 * np.quantile(depth, share)), float(np.quantile(color, share))


@pytest.mark.parametrize("rate", RATES.values(), ids=RATES)
@pytest.mark.parametrize("times_s", TIMES.values(), ids=TIMES)
def test_an_image_read_at_once_is_that_of_the_camera_in_the_middle_of_colour(
    times_s: Sequence[float], rate: Array
) -> None:
    late = readout(rate, times_s)
    seen, exact = frame(HERE, late), frame(HERE)
    found = read_at_once(seen, late)
    (before_mm, before), (after_mm, after) = (apart(one, exact, 0.95) for one in (seen, found))
    assert after_mm <= 0.12 * before_mm and after_mm < 0.8 and (before_mm > 3.0) == any(times_s[:2])
    assert after <= 0.2 * before and after < 0.004 and (before > 0.01) == (times_s[2] > 0)
    assert apart(found, exact, 1.0)[0] < 8.0, "at a corner, readings of two walls are not mixed"
    half = read_at_once(seen, Readout(0.5 * rate, 0.0, late.times))
    assert apart(half, exact, 0.95)[0] >= 0.3 * before_mm and apart(half, exact, 0.95)[1] >= 0.3 * before


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_holes_and_edges_are_not_mixed_with_a_surface(share: float) -> None:
    """Half a pixel is 5 mm on a slanted wall; a share of a hole or of another surface would be many times that."""
    late = readout(RATES["both"], TIMES["all"])
    seen, exact = frame(HERE, late), frame(HERE)
    holes = np.random.default_rng(0).random(seen.depth_m.shape) < share
    depth_m = np.where(holes, 0.0, seen.depth_m).astype(np.float32)
    found = read_at_once(Frame(0, 0.0, seen.color, depth_m, CAMERA), late).depth_m[INNER]
    errors_mm = 1e3 * np.abs(found - exact.depth_m[INNER])[found > 0]
    assert (found == 0).mean() == pytest.approx(share, abs=0.02)
    assert np.median(errors_mm) < 1.0 and np.quantile(errors_mm, 0.99) < 10.0 and errors_mm.max() < 25.0
    box = seen.depth_m.copy()
    box[40:80, 50:100] -= 0.5
    found = read_at_once(Frame(0, 0.0, seen.color, box, CAMERA), late).depth_m[INNER]
    apart_m = np.abs(found - exact.depth_m[INNER])
    assert np.quantile(np.minimum(apart_m, np.abs(apart_m - 0.5)), 0.999) < 0.01


def test_without_any_depth_there_is_none_when_read_at_once() -> None:
    late, seen = readout(RATES["both"], TIMES["all"]), frame(HERE)
    assert not read_at_once(Frame(0, 0.0, seen.color, np.zeros_like(seen.depth_m), CAMERA), late).depth_m.any()


def pairs(times_s: Sequence[float], count: int = 20, seed: int = 0) -> list[Pair]:
    """Return noisy images of half the size in pairs, of cameras that move differently every time."""
    random, found = np.random.default_rng(seed), []
    for k in range(count):
        rates = random.normal(0.0, 1.0, (2, 6)) * np.repeat([0.3, 0.4], 3)
        poses = [se3.exp(random.normal(0.0, 0.03, 6)) for _ in rates]
        halves = (
            image(T, readout(rate, times_s), 100 * k + i).half()
            for i, (T, rate) in enumerate(zip(poses, rates, strict=True))
        )
        guess = se3.exp(random.normal(0.0, 0.003, 6)) @ se3.inverse(poses[1]) @ poses[0]
        found.append(Pair(*halves, Readout(rates[0]), Readout(rates[1]), guess, k))
    return found


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("times_s", [(0.02, 0.03, 0.03), (-0.015, 0.0, 0.02), (0.0, 0.03, 0.0)], ids=str)
def test_the_times_of_a_sensor_are_measured(times_s: tuple[float, float, float], seed: int) -> None:
    found = completed(measured(pairs(times_s, seed=seed)))
    assert found.std_s is not None
    errors_s, std_s = times_of(found) - times_s, spread(np.array(found.std_s))
    assert np.abs(errors_s).max() < 1e-3 < min(found.std_s) and std_s.max() < 1e-3
    assert (np.abs(errors_s) < 3.0 * std_s).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_of_a_sensor_that_reads_at_once_nothing_is_found(seed: int) -> None:
    seen = pairs((0.0, 0.0, 0.0), seed=seed)
    assert completed(measured(seen)) is UNKNOWN_TIMES
    fit = completed(fitted(seen, THREE))
    assert not fit.sure and fit.std is not None
    std_s = spread(fit.std)
    assert (np.abs(fit.values) < 4.0 * std_s).all() and std_s.max() < 1e-3


def test_few_pairs_and_cameras_at_rest_tell_nothing() -> None:
    late = pairs((0.02, 0.03, 0.03))
    assert completed(measured([])) is UNKNOWN_TIMES
    assert completed(measured(late[: LEAST_PAIRS - 1])) is UNKNOWN_TIMES
    resting = Readout(np.zeros(6))
    still = [pair._replace(of_reference=resting, of_live=resting) for pair in late]
    assert completed(measured(still)) is UNKNOWN_TIMES


def test_a_newton_step_ends_at_the_lowest_point_of_a_quadratic() -> None:
    random = np.random.default_rng(3)
    lowest = random.normal(0.0, 0.02, (12, 3))
    roots = random.normal(0.0, 50.0, (12, 3, 3))
    bends = roots @ roots.transpose(0, 2, 1)

    def terms(at: Array, own: Array, numbers: Sequence[int]) -> list[Term]:
        slopes = [bend @ (at - low) for bend, low in zip(bends, own, strict=True)]
        return [Term(s, b, NEIGHBOURS * n) for s, b, n in zip(slopes, bends, numbers, strict=True)]

    start, common = np.array([0.01, -0.02, 0.03]), np.array([0.004, 0.005, -0.006])
    step, covariance = newton_step(terms(start, np.repeat(common[None], 12, 0), range(12)))
    np.testing.assert_allclose(start + step, common, atol=1e-9)
    np.testing.assert_allclose(covariance, 0.0, atol=1e-12)

    inverse = np.linalg.inv(bends.sum(0))
    best = inverse @ np.einsum("kij,kj->i", bends, lowest)
    shared = [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    step, covariance = newton_step(terms(start, lowest, shared))
    np.testing.assert_allclose(start + step, best, atol=1e-9)
    left = np.einsum("kij,kj->ki", bends, best - lowest).reshape(6, 2, 3).sum(1)
    np.testing.assert_allclose(covariance, 2.0 * inverse @ left.T @ left @ inverse, atol=1e-12)


def test_the_stated_error_of_a_few_groups_is_not_too_small() -> None:
    """Five groups of terms whose slopes have errors with a known covariance; three numbers are fitted to them."""
    random, bend, ratios = np.random.default_rng(7), np.diag([400.0, 900.0, 200.0]), list[float]()
    for _ in range(400):
        terms = [Term(slope, bend * random.uniform(0.3, 1.7), NEIGHBOURS * n)
                 for n, slope in enumerate(random.normal(size=(5, 3)))]  # fmt: skip
        total = np.sum([term.bend for term in terms], 0)
        ratios.append(float(np.trace(newton_step(terms)[1] @ total @ total)) / (5 * 3))
    assert 0.9 < np.mean(ratios) < 2.5


def test_far_from_the_lowest_point_a_newton_step_goes_down() -> None:
    bend, slope = np.diag([400.0, -300.0, 200.0]), np.array([4.0, 6.0, -2.0])
    step, _ = newton_step([Term(slope, bend, 0)])
    np.testing.assert_allclose(step, [-0.01, -0.02, 0.01], atol=1e-12)
