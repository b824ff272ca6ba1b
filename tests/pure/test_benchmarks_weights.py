"""benchmarks/weights.py: which runs it makes, how differences are judged, and its tables."""

import importlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from paired_comparison import Figure, PairedDifference

from benchmark_results import laid_out
from sigmasplat.errors import ConfigError

weights, weights_runs, weights_tables = map(importlib.import_module, ("weights", "weights_runs", "weights_tables"))


def row(source: str, seed: int, variant: str, ate_m: float, group: str = "path") -> dict[str, Any]:
    """Return the row of a run."""
    figures = {
        f.name: ate_m if f.name in ("ate_m", "rpe_m", "depth_l1_m") else 1.0 for f in weights_tables.FIGURES[group]
    }
    return {"source": source, "seed": seed, "group": group, "variant": variant, "figures": figures}


def made_up() -> list[dict[str, Any]]:
    """Return runs in which weights improve the errors of all sequences by about a fifth, and nothing else."""
    runs = []
    for source, gain in (("kitchen", 0.010), ("hall", 0.011), ("office", 0.012)):
        for seed in range(5):
            noise = 0.001 * (seed - 2)
            runs.append(row(source, seed, weights.DEFAULT, 0.05 - gain + noise))
            runs.append(row(source, seed, "tracking: no weights", 0.05))
            runs += [row(source, seed, variant, 0.0, "gate") for variant in ("V", "no weights")]
    return runs


def test_every_run_differs_from_the_default_in_the_settings_of_its_variant() -> None:
    jobs = weights.jobs_of(weights.Options(sources=("cubicles", "synthetic"), seeds=(3,)))
    assert len(jobs) == 2 * (1 + len(weights.PATH)) and len({weights.key(job) for job in jobs}) == len(jobs)
    default = next(job for job in jobs if job.variant == weights.DEFAULT).config()
    assert (default.seed, default.tracking.tau, default.registration.tau, default.loops.tau) == (3, 10.0, 10.0, 10.0)
    assert default.input.width == 240 and default.input.hold_every == 8
    for job in jobs:
        same = job.config() == next(j for j in jobs if j.source == job.source and j.variant == weights.DEFAULT).config()
        assert same is (job.variant == weights.DEFAULT), job.variant
    assert next(job for job in jobs if job.source == "synthetic").path.endswith("seed=3")
    with pytest.raises(ConfigError, match="no variant 'other'"):
        weights.jobs_of(weights.Options(variants=("other",)))


def test_a_change_helps_if_the_sequences_agree() -> None:
    tables = laid_out("weights", {"runs": made_up()})
    verdict = {cells[0]: cells for cells in tables["Verdicts"].rows}
    assert verdict["tracking by V"][1:3] == ["helps", "5"] and verdict["tracking by V"][4] == "–"
    assert verdict["tracking by V"][3].startswith("ATE (−22.0 ± 2.0 %); RPE (−22.0 ± 2.0 %); depth L1")
    assert verdict["loop gate by σ²"][1] == "no clear effect"
    (mean,) = tables["Complete runs, mean of sequences"].rows
    assert mean[1] == "**−22.0 ± 2.0 %**" and mean[3] == "0"
    assert "merging by σ²" not in verdict  # nothing was measured of it
    one = next(cells for cells in tables["Complete runs, differences"].rows if cells[1] == "kitchen")
    assert one[2] == "**−1.00 ± 0.16 cm**" and one[4] == "0"


def test_one_sequence_is_no_verdict_and_opposite_sequences_no_effect() -> None:
    of_one = [run for run in made_up() if run["source"] == "kitchen"]
    assert not laid_out("weights", {"runs": of_one}).get("Verdicts")
    turned = [
        run | {"figures": {name: 0.1 - value for name, value in run["figures"].items()}}
        if run["source"] == "hall" and run["variant"] == weights.DEFAULT else run
        for run in made_up() if run["source"] != "office"
    ]  # fmt: skip
    verdict = {cells[0]: cells[1] for cells in laid_out("weights", {"runs": turned})["Verdicts"].rows}
    assert verdict["tracking by V"] == "no clear effect"


@pytest.mark.parametrize(
    ("figures", "verdict"),
    [
        ({"a": 1.0, "b": 1.0}, "helps"), ({"a": -1.0, "b": 0.0}, "harms"), ({"a": 1.0, "b": -1.0}, "mixed"),
        ({"a": 0.0, "b": 0.0}, "no clear effect"),
    ],
)  # fmt: skip
def test_a_change_is_judged_by_all_its_figures(figures: dict[str, float], verdict: str) -> None:
    found = [
        PairedDifference(Figure(name, name, "dB", +1), tuple(effect + noise for noise in (-0.01, 0.0, 0.01)))
        for name, effect in figures.items()
    ]
    assert weights_tables.judgement(found) == verdict


def test_average_precision_is_one_if_true_pairs_come_first() -> None:
    labels = np.array([True, True, False, False])
    assert weights_runs.average_precision(np.array([4.0, 3.0, 2.0, 1.0]), labels) == 1.0
    assert weights_runs.average_precision(np.array([1.0, 2.0, 3.0, 4.0]), labels) == pytest.approx((1 / 3 + 1 / 2) / 2)


def test_pairs_to_register_leave_out_the_shared_keyframe() -> None:
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(6)
    far = poses.copy()
    far[:, 0, 3] += 9.0
    ((_, i, j, query, database),) = weights_runs.pairs_of([poses[:4], poses[3:], far])
    assert (i, j) == (0, 1) and 3 not in query and 0 not in database


def test_finished_jobs_of_other_code_are_made_again_unless_asked(tmp_path: Path) -> None:
    options = weights.Options(sources=("cubicles",), seeds=(0,), variants=("default",), collect=True, runs=tmp_path)
    (job,) = weights.jobs_of(options)
    gate = {"group": "gate", "variant": "V", "figures": {"average_precision": 0.5}}
    result = {"job": asdict(job), "code": "old", "commit": "c", "rows": [gate]}
    (tmp_path / "weights.jsonl").write_text(json.dumps(result) + "\n")
    assert weights.measure(options)["runs"] == []
    kept = weights.measure(weights.Options(**{**vars(options), "any_code": True}))["runs"]
    assert kept[0]["source"] == "cubicles" and kept[0]["figures"] == {"average_precision": 0.5}
