"""benchmarks/uncertainty_weights.py: weights are fitted to samples of several sequences, and laid out in tables."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
weights = importlib.import_module("uncertainty_weights")


def sequence(seed: int) -> dict[str, np.ndarray]:
    """Draw parts of variances, and errors with twice the shipped weights; depth has no view of another submap."""
    random, arrays = np.random.default_rng(seed), dict[str, np.ndarray]()
    for kind in (weights.PROBES, weights.OTHER_SUBMAPS, weights.HELD_BACK):
        for quantity, names in weights.PARTS.items():
            count = 0 if (kind, quantity) == (weights.OTHER_SUBMAPS, "depth") else 20_000
            shipped = weights.PULLED_TO[quantity]
            parts = np.stack([random.gamma(0.3, 0.01, count) / shipped[name] for name in names])
            variance = 2.0 * np.array([shipped[name] for name in names]) @ parts
            channels = 3 if quantity == "color" else 1
            arrays[f"{kind}|{quantity}|parts"] = parts
            arrays[f"{kind}|{quantity}|squared_error"] = variance[:, None] * random.normal(size=(count, channels)) ** 2
            arrays[f"{kind}|{quantity}|views"] = np.array(40.0)
    return arrays


def test_weights_are_fitted_to_all_sequences_and_scored_on_one() -> None:
    sequences = [sequence(0), sequence(1)]
    for quantity, names in weights.PARTS.items():
        found = weights.fitted(sequences, quantity)
        ratios = [found[name] / weights.PULLED_TO[quantity][name] for name in names]
        assert np.median(ratios) == pytest.approx(2.0, rel=0.2)
        for calibrated in (False, True):
            scores = weights.scored(sequence(2), quantity, weights.HELD_BACK, found, calibrated, 1.0)
            assert scores["auce"] < 0.03 and scores["coverage_68"] == pytest.approx(0.68, abs=0.04)


def test_the_temperature_is_half_way_to_68_percent() -> None:
    """Errors of a tenth of the pixels are three times as large: likelihood makes V too large for the others."""
    heavy = sequence(0)
    for quantity in weights.PARTS:
        heavy[f"{weights.PROBES}|{quantity}|squared_error"][::10] *= 9.0
        at_likelihood = weights.PULLED_TO[quantity]
        scale = weights.temperature([heavy], quantity, at_likelihood)
        covered = [
            weights.scored(heavy, quantity, weights.PROBES, at_likelihood, True, factor)["coverage_68"]
            for factor in (1.0, scale, scale**2)
        ]
        assert scale < 1.0 and covered[0] > covered[1] > covered[2] == pytest.approx(0.6827, abs=0.01)


def test_the_tables_have_a_row_for_each_sequence_and_kind_of_view(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "samples_of", lambda options, source: sequence(len(source)))
    figures = weights.measure(weights.Options(sources=("kitchen", "hall")))
    shipped, color, depth = weights.sections({"figures": figures})
    assert [row[0] for row in shipped.rows] == ["colour", "depth"]
    assert len(color.rows) == 2 * 2 * 2 and len(depth.rows) == 2 * 2, "depth has no views of other submaps"
    assert {len(row) for table in (color, depth) for row in table.rows} == {len(color.columns)}
