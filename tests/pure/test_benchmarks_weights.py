"""benchmarks/weights.py: which runs it makes, how differences are judged, and its tables."""

import importlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

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
    """Return runs in which weights improve the errors of two sequences and nothing else."""
    runs = []
    for source, gain in (("kitchen", 0.01), ("hall", 0.02), ("office", 0.0)):
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


def test_a_change_helps_only_beyond_the_seeds_of_several_sequences() -> None:
    tables = laid_out("weights", {"runs": made_up()})
    verdict = {cells[0]: cells for cells in tables["Verdicts"].rows}
    assert verdict["tracking by V"][1] == "helps"
    assert verdict["tracking by V"][2:] == ["5", "kitchen: ATE, RPE, depth L1; hall: ATE, RPE, depth L1", "–"]
    assert verdict["loop gate by σ²"][1] == "no effect"
    (mean,) = tables["Complete runs, mean of sequences"].rows
    assert mean[1] == "−20.0 ± 20.0 %" and mean[3] == "0"  # kitchen 20 %, hall 40 %, office none
    assert "merging by σ²" not in verdict  # nothing was measured of it
    one = next(cells for cells in tables["Complete runs, differences"].rows if cells[1] == "kitchen")
    assert one[2] == "**−1.00 ± 0.16 cm**" and one[4] == "0"


@pytest.mark.parametrize(
    ("better", "worse", "verdict"),
    [
        ({"a": ["x", "y", "z"]}, {}, "mixed"),
        ({"a": ["x"], "b": ["x"]}, {}, "helps"),
        ({"a": ["x"], "b": ["x"]}, {"c": ["x"]}, "mixed"),
        ({}, {"a": ["x"], "b": ["y"]}, "hurts"),
    ],
)
def test_a_verdict_needs_several_sequences(better: dict, worse: dict, verdict: str) -> None:
    assert weights_tables.judgement(better, worse, 10) == verdict
    assert weights_tables.judgement(better, worse, 100) == "no effect"


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
