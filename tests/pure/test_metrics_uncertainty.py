"""Scores of V against closed forms and against noise whose variance is known."""

import numpy as np
import pytest
from scipy import stats

from sigmasplat.plugins.evaluation.metrics.uncertainty import (
    LEVELS,
    auce,
    ause,
    calibration_scores,
    coverage,
    gaussian_nll,
    score,
    sparsification,
    spearman,
    z_scores,
)


def noise(n: int = 40_000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Draw squared errors from Gaussians with the predicted variances."""
    rng = np.random.default_rng(seed)
    variance = np.exp(rng.uniform(np.log(1e-4), np.log(1e-1), n))
    return variance, variance * rng.normal(size=n) ** 2


def test_spearman_depends_only_on_ranks() -> None:
    v = np.linspace(0.1, 2.0, 50)
    assert spearman(v, v**5) == pytest.approx(1.0)
    assert spearman(v, -np.exp(v)) == pytest.approx(-1.0)
    x, y = noise(500)
    ranks = np.corrcoef(stats.rankdata(x), stats.rankdata(y))[0, 1]
    assert spearman(x, y) == pytest.approx(ranks)
    assert np.isnan(spearman(np.ones(5), v[:5])) and np.isnan(spearman(v[:1], v[:1]))


def test_nll_is_the_gaussian_log_density_without_its_constant() -> None:
    v, e = noise(1000)
    expected = -stats.norm.logpdf(np.sqrt(e), 0.0, np.sqrt(v + 1e-6)).mean() - 0.5 * np.log(2 * np.pi)
    assert gaussian_nll(v, e) == pytest.approx(expected)


def test_nll_is_lowest_at_the_true_variance() -> None:
    v, e = noise()
    for wrong in (v * 2, v / 2, np.full_like(v, e.mean())):
        assert gaussian_nll(v, e) < gaussian_nll(wrong, e)


def test_a_slightly_negative_variance_gives_a_finite_nll() -> None:
    assert np.isfinite(gaussian_nll(np.array([-1e-6, 0.0]), np.array([0.1, 0.0])))


def test_sparsification_by_hand() -> None:
    e = np.array([4.0, 1.0, 9.0, 0.0])
    np.testing.assert_allclose(sparsification(e, e, 4) ** 2, [14 / 4, 5 / 3, 1 / 2, 0.0])
    np.testing.assert_allclose(sparsification(-e, e, 4) ** 2, [14 / 4, 14 / 3, 13 / 2, 9.0])


def test_ause_is_lower_for_a_better_ranking() -> None:
    v, e = noise()
    shuffled = np.random.default_rng(1).permutation(v)
    assert ause(e, e) == 0.0
    assert ause(np.sqrt(e), e) == 0.0, "only the order matters"
    assert 0.0 < ause(v, e) < ause(shuffled, e) < ause(-v, e)
    # A random order does not reduce the error, so its area equals that of the oracle curve below the initial error.
    drop = 1.0 - sparsification(e, e).mean() / sparsification(e, e)[0]
    assert ause(shuffled, e) == pytest.approx(drop, abs=0.03)
    assert np.isnan(ause(np.empty(0), np.empty(0))) and np.isnan(ause(np.ones(3), np.zeros(3)))


def test_intervals_of_a_true_variance_contain_their_share() -> None:
    v, e = noise()
    np.testing.assert_allclose(coverage(v, e, LEVELS), LEVELS, atol=0.01)
    assert auce(v, e, 0.0) < 0.005
    scores = calibration_scores(v, e, 0.0)
    assert scores["coverage_68"] == pytest.approx(0.6827, abs=0.01)
    assert scores["coverage_95"] == pytest.approx(0.95, abs=0.01)
    assert scores["z_rms"] == pytest.approx(1.0, abs=0.02) and scores["z_68"] == pytest.approx(1.0, abs=0.02)


def test_intervals_of_a_color_contain_their_share_of_the_errors_of_single_channels() -> None:
    """The mean of three independent channels is closer to V than a channel: its coverage is wrong for the true V."""
    v, _ = noise()
    channels = v[:, None] * np.random.default_rng(5).normal(size=(len(v), 3)) ** 2
    scores = calibration_scores(v, channels, 0.0)
    assert scores["auce"] < 0.005 and scores["coverage_68"] == pytest.approx(0.6827, abs=0.01)
    assert auce(v, channels.mean(1), 0.0) > 0.1
    assert scores["nll"] == pytest.approx(gaussian_nll(v, channels.mean(1), 0.0))
    assert z_scores(v, channels)["z_rms"] == pytest.approx(z_scores(v, channels.mean(1))["z_rms"])


@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_auce_of_a_scaled_variance_is_that_of_the_formula(factor: float) -> None:
    v, e = noise()
    inside = 2.0 * stats.norm.cdf(np.sqrt(factor) * stats.norm.ppf(0.5 + 0.5 * LEVELS)) - 1.0
    assert auce(factor * v, e, 0.0) == pytest.approx(np.abs(inside - LEVELS).mean(), abs=0.005)
    assert auce(factor * v, e, 0.0) > 0.05


def test_the_largest_auce_is_one_half() -> None:
    v, e = noise(100)
    assert auce(1e9 * v, e) == pytest.approx(0.5) and auce(1e-9 * v, e + 1.0, 0.0) == pytest.approx(0.5)


def test_the_mean_squared_z_score_is_the_scale_of_the_highest_likelihood() -> None:
    v, e = noise()
    assert z_scores(3.0 * v, e, 0.0)["z_rms"] ** 2 == pytest.approx(1 / 3, rel=0.03)
    best = z_scores(v, 5.0 * e)["z_rms"] ** 2
    for factor in (0.8, 1.25):
        assert gaussian_nll(best * v, 5.0 * e) < gaussian_nll(factor * best * v, 5.0 * e)
    assert best == pytest.approx(calibration_scores(v, 5.0 * e)["z_rms"] ** 2)


def test_scores_without_pixels_are_nan() -> None:
    values = score(np.empty(0), np.empty(0))
    assert values["pixels"] == 0 and np.isnan(values["spearman"])
    assert all(np.isnan(value) for value in calibration_scores(np.empty(0), np.empty(0)).values())
    assert np.isnan(z_scores(np.empty(0), np.empty(0))["z_rms"])
