"""The benchmarks of presets and of the rules that end submaps: their settings and their tables."""

import importlib
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from benchmark_results import laid_out
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override, split_settings
from sigmasplat.run_folder.runs import RunFolder

accuracy = importlib.import_module("accuracy")
every_preset = importlib.import_module("every_preset")
paper_presets = importlib.import_module("paper_presets")


@pytest.mark.parametrize("name", every_preset.EVERY)
def test_a_shortened_preset_stays_what_it_is_and_cuts_often(name: str) -> None:
    whole, short = preset(name), override(preset(name), split_settings(every_preset.shortened(preset(name))))
    assert short.mapping.iterations <= 8 and short.final.iterations <= 40 and short.input.width == 160
    assert bool(short.submaps.frames) == any(
        (whole.submaps.distance_m, whole.submaps.angle_deg, whole.submaps.frames, whole.submaps.uncertainty_m)
    )
    assert (short.mapping.window, short.mapping.covisibility) == (whole.mapping.window, whole.mapping.covisibility)


def test_presets_that_fail_are_listed_with_their_last_line() -> None:
    def result(name: str, problem: str | None, **figures: Any) -> dict[str, Any]:
        return {"job": {"source": "kitchen", "preset": name, "seed": 0}, "problem": problem, "figures": figures}

    good = result("sigma", None, frames=75, submaps=5, ate_m=0.0123, judged_on="training")
    shown, failed = laid_out("every_preset", {"jobs": [good, result("other", "no list of splats")]}).values()
    assert shown.title == "kitchen" and shown.rows == [
        ["sigma", "75", "–", "–", "5", "–", "–", "–", "1.23", "–", "–", "training"]
    ]
    assert any("no list of splats" in cell for row in failed.rows for cell in row)


def test_a_collection_has_the_runs_that_ended_and_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names = {"varsplat-fast": None, "sigma": "no list of splats", "loopsplat-fast": None}
    options = every_preset.Options(
        sources=("kitchen",), presets=(*names, "cgslam-fast"), runs=tmp_path / "runs", out=tmp_path, collect=True
    )
    counts = {"submaps": 4, "loops": {"tried": 3, "accepted": 1}, "uncertainty": None}
    for job in accuracy.jobs_of(options):
        job = replace(job, settings=every_preset.shortened(preset(job.preset)))
        if job.preset not in names:
            continue
        (job.folder(options.runs) / "run").mkdir(parents=True)
        (job.folder(options.runs) / "run/metrics.json").write_text(json.dumps(counts))
        result = {"job": asdict(job), "key": job.key(), "problem": names[job.preset], "figures": {"frames": 45}}
        if job.preset == "loopsplat-fast":
            result["key"] = {**result["key"], "code": "older code"}
        (job.folder(options.runs) / "result.json").write_text(json.dumps(result))
    monkeypatch.setattr(RunFolder, "open", lambda folder: RunFolder(folder))
    monkeypatch.setattr(accuracy, "perform", lambda *job: pytest.fail("a run was started"))
    assert every_preset.main(options) == 1  # one of the runs that ended had failed
    said = capsys.readouterr()
    assert "2 of 4 runs" in said.err and "varsplat-fast" in said.out and "no list of splats" in said.out
    assert "loopsplat-fast" not in said.out and "cgslam-fast" not in said.out


def test_a_light_preset_runs_at_half_the_size_of_the_other() -> None:
    full, light = (
        override(preset(name), split_settings(paper_presets.sized(name))) for name in ("cgslam-tum", "cgslam-light-tum")
    )
    assert (full.input.width, light.input.width) == (320, 160)
    assert full == replace(light.changed(input={"width": 320}), name=full.name)

    def result(name: str, width_px: int) -> dict[str, Any]:
        job = {"source": "kitchen", "preset": name, "settings": [f"input.width={width_px}"]}
        return {"job": job, "problem": None, "figures": {"frames": 120, "ate_m": 0.02}}

    results = [result("cgslam-light-tum", 320), result("cgslam-light-replica", 160), result("cgslam-tum", 320)]
    shown = laid_out("paper_presets", {"jobs": results})["kitchen"]
    assert [row[0] for row in shown.rows] == [
        "cgslam-light-tum (not light: full size)", "cgslam-light-replica", "cgslam-tum",
    ]  # fmt: skip


def test_both_rules_are_judged_by_the_errors_where_they_fire() -> None:
    def hop(error_m: float, added: float, cut: bool) -> dict[str, Any]:
        return {"error_m": error_m, "added_m2": added, "variance": -added, "cut": cut}

    hops = [hop(0.01, 1.0, False), hop(0.02, 2.0, False), hop(0.05, 3.0, True)]
    runs = [{"source": "kitchen", "rule": rule, "submaps": 2, "lost": 0, "hops": hops} for rule in ("covariance", "V")]
    (section,) = laid_out("drift_rule", {"sources": runs}, config={"uncertainty_m": 0.02}).values()
    by_covariance, by_v = section.rows
    assert by_covariance[:2] == ["kitchen", "covariance"] and by_v[:2] == ["kitchen", "V"]
    assert by_covariance[5] == "5.00" and by_covariance[7] == "1.50"
    assert (by_covariance[-1], by_v[-1]) == ("1.0", "-1.0")
