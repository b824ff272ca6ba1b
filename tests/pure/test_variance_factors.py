"""Factors on assumed variances, found from residuals."""

import numpy as np
import pytest

from sigmasplat.graph.variance_factors import variance_factors


def test_factors_are_those_of_the_drawn_residuals() -> None:
    rng = np.random.default_rng(0)
    first, second = np.diag(np.repeat([1.0, 0.0], 150)), np.diag(np.repeat([0.0, 1.0], 150))
    fixed = 1e-4 * np.eye(300)
    residuals = rng.normal(size=300) * np.sqrt(np.diag(fixed + 0.2 * first + 5.0 * second))
    assert variance_factors(residuals, fixed, [first, second]) == pytest.approx([0.2, 5.0], rel=0.3)


def test_a_part_without_information_keeps_its_variance() -> None:
    unseen = np.zeros((6, 6))
    assert variance_factors(np.ones(6), np.eye(6), [unseen]) == pytest.approx([1.0], abs=0.01)
    assert variance_factors(np.zeros(6), np.eye(6), [1e-6 * np.eye(6)]) == pytest.approx([1.0], abs=0.01)


def test_few_residuals_move_a_factor_less_than_many() -> None:
    few, many = (variance_factors(0.1 * np.ones(n), 1e-4 * np.eye(n), [np.eye(n)])[0] for n in (1, 100))
    assert many == pytest.approx(0.02, rel=0.3) and few > 5.0 * many
