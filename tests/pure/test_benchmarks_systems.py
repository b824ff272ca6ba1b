"""The benchmarks of whole systems and of the consistent field: what they run, what they read, what their tables say."""

import importlib
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmark_results import laid_out
from sigmasplat.errors import ConfigError
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.run_folder.runs import RunFolder

accuracy, consistency, systems, tables = map(
    importlib.import_module,
    ("accuracy", "consistency", "systems", "tables"),
)
ROOM = "synthetic:frames=120,width=64,height=48,noise=1"
TINY = ("input.width=64", "mapping.first_iterations=30", "mapping.iterations=8", "final.iterations=5")

NOTHING: dict[str, Any] = systems.figures_of({})


def result(source: str, preset: str, seed: int, problem: str | None = None, **figures: float) -> dict[str, Any]:
    job = {"source": source, "preset": preset, "seed": seed}
    return {"job": job, "problem": problem, "peak_mib": 512.0, "figures": NOTHING | figures}


def test_systems_are_compared_on_the_same_input_only() -> None:
    """Each refusal prints a setting that mends it, until nothing differs."""
    pair, settings = ("varsplat-fast", "varsplat-tum"), list[str]()
    while len(settings) < 20:
        try:
            systems.refuse_unequal_input(pair, settings)
            break
        except ConfigError as refused:
            settings.append(str(refused).partition("--set ")[2])
    assert "input.width=0" in settings and len(settings) == len(set(settings)) < 20
    systems.refuse_unequal_input(("varsplat-fast", "loopsplat-fast"), ())
    assert systems.main(systems.Options(presets=pair)) == systems.main(systems.Options(presets=("nothing",))) == 2


def test_each_sequence_has_a_table_with_a_column_for_each_system() -> None:
    made = laid_out("systems", {"jobs": [
        result("synthetic", "a", 0, ate_m=0.01, accuracy_m=0.02, map_bytes=2_500_000, worst_frame_s=0.25, lost=0),
        result("synthetic", "a", 1, ate_m=0.03, accuracy_m=0.02, map_bytes=2_500_000, worst_frame_s=0.75, lost=0),
        result("synthetic", "b", 0, ate_m=0.05, completion_ratio=0.875, spearman=0.5, lost=2),
        result("synthetic", "b", 1, problem="lost | its way"),
        result("redkitchen", "a", 0, ate_m=0.07),
    ]})  # fmt: skip
    assert list(made) == ["synthetic", "redkitchen", "Failed"]
    assert list(made["synthetic"].columns) == ["figure", "a", "b"]
    rows = {row[0]: row[1:] for row in made["synthetic"].rows}
    assert rows["runs"] == ["2", "1"] and rows["ATE, cm"] == ["2.00 ± 1.4", "5"] and rows["lost frames"] == ["0", "2"]
    assert rows["map, MB"] == ["2.50 ± 0.0", "–"] and rows["worst frame, ms"] == ["500 ± 350", "–"]
    assert rows["Completion ratio, %"] == ["–", "87.5"] and rows["Spearman V ~ error²"] == ["–", "0.500"]
    assert "Completion, cm" not in rows and {row[0] for row in made["redkitchen"].rows} == {
        "runs", "ATE, cm", "peak memory, MiB",
    }  # fmt: skip


def test_every_figure_of_a_table_is_one_that_is_picked() -> None:
    picked = systems.figures_of({"worst_frame_s": 0.5, "reconstruction": {"floaters": 0.25, "accuracy_m": None}})
    assert picked["worst_frame_s"] == 0.5 and picked["floaters"] == 0.25 and picked["map_bytes"] is None
    assert {figure for _, figure, _ in systems.ROWS} - {"peak_mib"} <= set(picked)
    assert {figure.name for figure in consistency.FIGURES} <= set(picked)


@pytest.fixture
def job(tmp_path: Path) -> Any:
    """Leave a run without a scored surface where its job has it."""
    job = accuracy.Job("room", ROOM, "varsplat-fast", 0, (), 5, "abc")
    folder = RunFolder.create(job.folder(tmp_path) / "run", BASE, "room")
    folder.write_metrics({"ate": {"rmse_m": 0.5}, "reconstruction": None})
    return job


def test_a_surface_is_scored_once_and_where_it_is_known(
    tmp_path: Path, job: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    called = []

    def call(command: list[str], output: Path) -> tuple[str | None, float]:
        called.append(command)
        RunFolder(job.folder(tmp_path) / "run").write_metrics({"reconstruction": {"floaters": 0.125}, "lost": 3})
        return None, 1.0

    monkeypatch.setattr(accuracy, "call", call)
    monkeypatch.setattr(systems, "open_source", lambda path: Surfaceless())
    done = result("room", "p", 0)
    assert systems.with_surface(job, done, tmp_path)["figures"]["ate_m"] == 0.5 and not called
    monkeypatch.undo()
    monkeypatch.setattr(accuracy, "call", call)
    for _ in range(2):
        found = systems.with_surface(job, done, tmp_path, ["taskset", "-c", "0"])
        assert found["figures"]["floaters"] == 0.125 and found["figures"]["lost"] == 3 and found["problem"] is None
    run = str(job.folder(tmp_path) / "run")
    assert len(called) == 1 and called[0] == ["taskset", "-c", "0", sys.executable, "-m", "sigmasplat.cli", "eval", run,
                                              "--mesh", "--random-views", "0"]  # fmt: skip


class Surfaceless:
    """A source that does not know its surface."""

    def true_surface(self) -> None:
        return None


def test_what_cannot_be_scored_is_a_problem(tmp_path: Path, job: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    failed = result("room", "p", 0, problem="stopped")
    assert systems.with_surface(job, failed, tmp_path) is failed
    monkeypatch.setattr(accuracy, "call", lambda command, output: ("sigmasplat: no map", 1.0))
    assert systems.with_surface(job, result("room", "p", 0), tmp_path)["problem"] == "eval --mesh: sigmasplat: no map"
    (job.folder(tmp_path) / "run" / "metrics.json").unlink()
    assert "no metrics.json" in systems.with_surface(job, result("room", "p", 0), tmp_path)["problem"]


def test_variants_leave_out_what_they_say_and_nothing_else() -> None:
    options = consistency.Options(preset="varsplat-fast", seeds=(5,), scenes=("two rooms", ROOM), limit=301)
    listed = consistency.jobs_of(options)
    assert [variant for variant, _ in listed] == 2 * list(consistency.VARIANTS) and len(
        {job for _, job in listed}
    ) == 12
    assert {job.limit for _, job in listed[:6]} == {300} and {job.limit for _, job in listed[6:]} == {301}
    assert {job.path for _, job in listed[6:]} == {ROOM}
    own = ("mapping.weight_alignment=2", "mapping.weight_moment=3", "mapping.weight_isotropy_ratio=4",
           "primitives.uncertain_m2=5")  # fmt: skip
    on = consistency.Options(preset="varsplat-fast", scenes=("room",), seeds=(5,), settings=own)
    configs = {variant: job.key()["config"] for variant, job in consistency.jobs_of(on)}
    found = {
        variant: [config["mapping"][f"weight_{term}"] for term in ("alignment", "moment", "isotropy_ratio")]
        + [config["primitives"]["uncertain_m2"]]
        for variant, config in configs.items()
    }
    assert found == {
        "full": [2, 3, 4, 5],
        "without alignment": [0, 3, 4, 5],
        "without variance": [2, 0, 4, 5],
        "without both": [0, 0, 4, 5],
        "without isotropy": [2, 3, 0, 5],
        "without primitive uncertainty": [2, 3, 4, 0],
    }


@pytest.mark.parametrize("changes", [{"variants": ("without sense",)}, {"jobs": 0}, {"jobs": 10_000}])
def test_options_that_mean_nothing_are_refused(changes: dict[str, Any]) -> None:
    assert consistency.main(consistency.Options(**{"preset": "varsplat-fast"} | changes)) == 2


def test_an_ablation_is_judged_at_equal_scene_and_seed() -> None:
    jobs = [
        {"variant": variant, **result(scene, "p", seed, ate_m=ate_m, floaters=0.01)}
        for scene, seed, full_m, without_m in (
            ("room", 0, 0.01, 0.03),
            ("room", 1, 0.02, 0.05),
            ("hall", 0, 0.05, 0.13),
        )
        for variant, ate_m in (("full", full_m), ("without both", without_m))
    ]
    jobs.append({"variant": "without both", **result("hall", "p", 1, problem="lost")})
    made = laid_out("consistency", {"jobs": jobs})
    assert list(made) == ["Mean of scenes", "Effects", "room", "hall", "Failed"]
    assert [row[1] for row in made["Mean of scenes"].rows] == ["**3.25**", "8.50"], "of the scenes' means"
    assert [row[:2] for row in made["Effects"].rows] == [["without both", "**+4.33 ± 3.21 cm**, 3/3"]]
    assert made["Effects"].rows[0][5] == "0, 0/3" and made["Effects"].rows[0][2] == "–"
    assert made["room"].rows[0][:2] == ["full", "**1.50 ± 0.71**"]
    assert not {"Effects", "Mean of scenes"} & set(laid_out("consistency", {"jobs": jobs[-1:]}))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("taskset") is None, reason="runs are kept on their cores by taskset")
def test_a_tiny_ablation_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = consistency.Options(
        scenes=(ROOM,), variants=("full",), preset="varsplat-fast", seeds=(0,), settings=TINY, limit=6,
        runs=tmp_path / "runs", out=tmp_path / "out",
    )  # fmt: skip
    assert consistency.main(options) == 0
    (written,) = (tmp_path / "out").glob("consistency-*.json")
    (job,) = json.loads(written.read_text())["figures"]["jobs"]
    assert job["variant"] == "full" and job["problem"] is None
    shown = [figure.name for figure in consistency.FIGURES]
    assert all(job["figures"][name] is not None for name in shown)
    assert 0 < job["figures"]["splats_chamfer_m"] < 0.5 and 0 <= job["figures"]["floaters"] < 1
    assert job["figures"]["worst_frame_s"] > 0 and job["figures"]["map_bytes"] > 1000
    assert "**Mean of scenes**" in capsys.readouterr().out
    assert consistency.main(options) == 0 and "run before" in capsys.readouterr().err
