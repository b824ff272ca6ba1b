"""benchmarks/uncertainty.py: results are kept without paths and laid out with one row per sequence and predictor."""

import importlib
import sys
from pathlib import Path
from typing import Any

from benchmark_results import laid_out

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
uncertainty, tables = map(importlib.import_module, ("uncertainty", "tables"))


def scores(nll: float) -> dict[str, Any]:
    """Return the scores of two predictors."""
    found = {"nll": nll, "auce": 0.1, "coverage_68": 0.7, "coverage_95": 0.9, "z_rms": 1.0, "z_68": 1.0}
    row = {
        "ause": 0.2,
        "spearman": None,
        "before": found,
        "after": found,
        "temperature": 2.0,
        "after_68": found,
        "temperature_68": 1.0,
    }
    row |= {"best_scale": 1.5, "nll_at_best_scale": nll, "mean_variance": 0.1, "mean_squared_error": 0.1}
    of_pixels = {"pixels": 10, "in_sample": False, "predictors": {"constant": row, "V": row}}
    return {"color": {"final": {"held back": {"all pixels": of_pixels}}}}


def runs() -> list[dict[str, Any]]:
    """Return two seeds of one sequence and one seed of another."""
    made = [("/data/kitchen", 0, -2.0), ("/data/kitchen", 1, -3.0), ("/data/hall", 0, 1500.0)]
    return [{"source": path, "path": path, "seed": seed, "scores": scores(nll)} for path, seed, nll in made]


def test_results_are_kept_by_name_and_laid_out() -> None:
    kept = uncertainty.kept({"config": {}, "hold_every": 8, "runs": runs()})
    assert [run["source"] for run in kept["runs"]] == ["kitchen", "kitchen", "hall"]
    row = kept["runs"][0]["scores"]["color"]["final"]["held back"]["all pixels"]["predictors"]["V"]
    assert row["temperature"] == 2.0 and "mean_variance" not in row
    (section,) = uncertainty.sections({"figures": kept})
    assert section.title == "colour, final, held back, all pixels"
    assert [row[:2] for row in section.rows] == [[s, p] for s in ("kitchen", "hall") for p in ("constant", "V")]
    assert section.rows[0][2] == "−2.50 ± 0.71" and section.rows[2][2] == "1\u202f500"
    assert "other sequences" in section.note and len(section.columns) == len(section.rows[0])


def test_the_coverage_of_predicted_errors_has_a_row_per_sequence_and_kind_of_views() -> None:
    made = runs()
    for run in made:
        for quantity, subset in (("color", "all pixels"), ("depth", "covered pixels")):
            found = scores(-2.0)["color"]["final"]["held back"]["all pixels"]
            found["predictors"]["predictive"] = found["predictors"]["V"]
            run["scores"].setdefault(quantity, {"final": {}})["final"] |= {"held back": {subset: found}}
    made[0]["scores"]["color"]["final"]["away from the path"] = made[0]["scores"]["color"]["final"]["held back"]
    coverage, *_ = uncertainty.sections({"figures": uncertainty.kept({"config": {}, "hold_every": 8, "runs": made})})
    assert [row[:2] for row in coverage.rows] == [
        ["kitchen", "held back"],
        ["hall", "held back"],
        ["kitchen", "away from the path"],
    ]
    assert coverage.rows[1][2:] == ["70", "90", "0.100"] * 2 and coverage.rows[2][5:] == ["–"] * 3
    assert len(coverage.columns) == len(coverage.rows[0])


def test_poses_and_failures_have_tables_of_their_own() -> None:
    motion = {"count": 39, "nees_mean": 6.0, "nees_median": 5.0, "coverage_90": 0.9}
    motion |= {"position_coverage_90": 0.85, "position_k": 1.1}
    poses = {"window_frames": 50, "hops": motion, "windows": None, "from_start": motion | {"count": 199}}
    failures = {"frames": 200, "off": 3, "auroc": 0.97, "brier": 0.01}
    unknown, known = {"poses": None, "failures": None}, {"poses": poses, "failures": failures}
    made = [run | (known if run["source"] == "/data/kitchen" else unknown) for run in runs()]
    *_, of_poses, of_failures = uncertainty.sections({"figures": {"runs": made}})
    assert [row[:3] for row in of_poses.rows] == [
        ["/data/kitchen", "keyframe to keyframe", "39 ± 0"], ["/data/kitchen", "from the start", "199 ± 0"],
    ]  # fmt: skip
    assert [row[1] for row in of_failures.rows] == ["200 ± 0"] and of_failures.rows[0][3] == "0.970 ± 0.000"
    assert all(len(section.columns) == len(row) for section in (of_poses, of_failures) for row in section.rows)


def test_the_own_error_of_a_measured_truth_has_columns_beside_those_without_it() -> None:
    motion = {"count": 39, "nees_mean": 6.0, "nees_median": 5.0, "coverage_90": 0.2}
    motion |= {"position_coverage_90": 0.1, "position_k": 9.0}
    beside = {"coverage_90_with_truth": 0.8, "position_coverage_90_with_truth": 0.7, "position_k_with_truth": 1.5}
    kinds = ("hops", "windows", "from_start")
    room = {"source": "room", **dict.fromkeys(kinds, motion), "windows": None}
    desk = {"source": "desk", "truth_error_m": 0.004, "truth_error_deg": 0.3, **dict.fromkeys(kinds, motion | beside)}
    alone = laid_out("pose_covariance", {"sources": [room]})["Covariance of poses"]
    both = laid_out("pose_covariance", {"sources": [room, desk]})["Covariance of poses"]
    assert alone.rows[0][2:] == ["39", "6.00", "5.00", "20.0", "10.0", "9.00"]
    assert alone.rows[1] == ["room", "50 frames", "0", *["–"] * 5]
    assert both.rows[3][5:] == ["20.0", "10.0", "9.00", "80.0", "70.0", "1.50"] and both.rows[0][8:] == ["–"] * 3
    assert "desk 4 mm, 0.3°" in both.note and "own error" not in alone.note


def test_options_say_what_to_measure(tmp_path: Path) -> None:
    options = uncertainty.Options(sources=("synthetic",), seeds=2, limit=30, runs=tmp_path)
    jobs = options.study().jobs()
    assert [(job.seed, f"seed={job.seed}" in job.path, job.config.input.limit) for job in jobs] == [
        (0, True, 30), (1, True, 30),
    ]  # fmt: skip
    assert options.folder() == tmp_path / "uncertainty"
