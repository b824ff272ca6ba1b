"""Weights of a predicted variance: found from errors, pulled to given weights where errors are few."""

import numpy as np
import pytest

from sigmasplat.uncertainty.calibration import fit_weights

TRUE = {"a": 0.3, "b": 2.0, "c": 1e-4}
START = {"a": 1.0, "b": 1.0, "c": 1e-3}


def drawn(pixels: int, seed: int = 0) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return random parts of the variance of pixels, and squared errors with the weights `TRUE`."""
    rng = np.random.default_rng(seed)
    parts = {"a": rng.gamma(0.5, 0.02, pixels), "b": rng.gamma(0.3, 0.003, pixels), "c": np.ones(pixels)}
    variance = sum(TRUE[name] * plane for name, plane in parts.items())
    return parts, variance * rng.normal(size=pixels) ** 2


def test_the_weights_that_made_the_errors_are_found() -> None:
    parts, errors = drawn(200_000)
    found = fit_weights(parts, errors, START, views=2000)
    assert found == pytest.approx(TRUE, rel=0.05)
    assert found == fit_weights(parts, errors, START, views=2000), "the same errors give the same weights"


def test_without_pixels_the_weights_are_the_given_ones() -> None:
    assert fit_weights({}, np.empty(0), START, views=0) == START


def test_few_views_stay_nearer_to_the_given_weights() -> None:
    parts, errors = drawn(4000)
    found = [fit_weights(parts, errors, START, views) for views in (1, 10, 1000)]
    off = [sum(np.log(weights[name] / START[name]) ** 2 for name in START) for weights in found]
    assert 0 < off[0] < off[1] < off[2]


def test_a_part_that_errors_do_not_show_gets_almost_no_weight() -> None:
    parts, errors = drawn(100_000)
    parts["d"] = np.random.default_rng(1).gamma(0.5, 0.02, len(errors))
    found = fit_weights(parts, errors, START | {"d": 0.1}, views=2000)
    assert found["d"] < 0.01 and found["a"] == pytest.approx(TRUE["a"], rel=0.1)


def test_a_limit_keeps_gross_errors_from_deciding() -> None:
    parts, errors = drawn(100_000)
    errors[::200] += 1.0
    plain, limited = (fit_weights(parts, errors, START, 2000, limit)["c"] for limit in (np.inf, 3.0))
    assert limited < 3 * TRUE["c"] < plain


def test_a_firm_weight_stays_near_the_given_one() -> None:
    parts, errors = drawn(4000)
    free, firm = (fit_weights(parts, errors, START, 3, firm=names) for names in ((), ("b",)))
    moved = [abs(np.log(found["b"] / START["b"])) for found in (free, firm)]
    assert moved[1] < 0.3 * moved[0]
    assert firm["a"] < 0.9 * START["a"], "the others are fitted"
