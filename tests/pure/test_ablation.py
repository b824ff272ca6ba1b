"""The ablation: variants differ by one weight, no run is repeated or lost, and verdicts follow from the figures."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import ablation as bench_ablation
import ablation_runs as ablation
import numpy as np
import pytest
import record
import tables
from ablation_runs import COMPARED, NAMES, WITHOUT_VARIANCE, Job, Results, Study, run_jobs
from paired_comparison import (
    FIGURES,
    best,
    columns,
    described,
    figures_of,
    paired_differences,
    spread,
)

import sigmasplat
from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.errors import RunError
from sigmasplat.files.machine import INSTALLED, code_digest
from sigmasplat.run.terminal import Screen
from sigmasplat.run_folder.runs import RunFolder

BASE = preset("varsplat-fast")


def flat(config: Config) -> dict[str, Any]:
    """Return settings by full name."""
    sections = config.to_dict()
    inner = {f"{s}.{n}": v for s, vs in sections.items() if isinstance(vs, dict) for n, v in vs.items()}
    return inner | {name: value for name, value in sections.items() if not isinstance(value, dict)}


def metrics(
    ate_m: float | None = 0.01, before: float | None = None, after: float = 25.0, **more: Any
) -> dict[str, Any]:
    """Return metrics as an evaluation writes them."""
    return {
        "ate": None if ate_m is None else {"rmse_m": ate_m},
        "held_out": {"psnr_db": after, "depth_l1_m": 0.02},
        "held_out_submaps": None if before is None else {"psnr_db": before},
        "lost": 0, "frames_per_s": 12.5, "loops": {"tried": 3, "accepted": 1}, **more,
    }  # fmt: skip


class MadeUpRuns:
    """Replace SLAM: record the jobs, return `ate_m` of the variant, stop at job `stop_at`."""

    def __init__(self, ate_m: Mapping[str, float] | None = None, stop_at: int | None = None) -> None:
        self.ate_m, self.stop_at = ate_m or {}, stop_at
        self.jobs: list[Job] = []
        self.folders: list[Path] = []

    def __call__(self, job: Job, folder: Path) -> dict[str, Any]:
        if len(self.jobs) == self.stop_at:
            raise KeyboardInterrupt
        self.jobs.append(job)
        self.folders.append(folder)
        folder.mkdir(parents=True)
        return metrics(self.ate_m.get(job.variant, 0.01) + 1e-4 * job.seed, before=24.0)


def runs_of(**ate_m: list[float | None]) -> list[dict[str, Any]]:
    """Return runs of variants named by letters, with these ATEs in metres at seeds 0, 1, …"""
    return [
        {"variant": variant, "seed": seed, "figures": figures_of(metrics(value)), "path": "x", "source": "x"}
        for variant, values in ate_m.items()
        for seed, value in enumerate(values)
    ]


def test_each_variant_enables_one_more_weight_and_nothing_else() -> None:
    study = Study(("room",), BASE, seeds=1, without_variance=True)
    settings = {job.variant: flat(job.config) for job in study.jobs("room")}
    assert list(settings) == [WITHOUT_VARIANCE, *NAMES]
    switched = ["tracking.uncertainty", "loops.uncertainty", "registration.uncertainty", "final.uncertainty"]
    for before, after, weight in zip(NAMES, NAMES[1:], switched, strict=False):
        differing = {name for name in flat(BASE) if settings[before][name] != settings[after][name]}
        assert differing == {weight} and settings[after][weight] is True
    assert not any(settings["none"][weight] for weight in switched)
    assert {settings[name]["mapping.weight_nll_color"] for name in NAMES} == {BASE.mapping.weight_nll_color}
    none, without = settings["none"], settings[WITHOUT_VARIANCE]
    assert {name for name in none if none[name] != without[name]} == {"mapping.weight_nll_color"}
    assert without["mapping.weight_nll_color"] == without["mapping.weight_nll_depth"] == 0
    assert {name for pair in COMPARED for name in pair} == set(settings)


def test_tau_is_the_same_for_every_weight_and_settings_apply_to_all() -> None:
    config = ablation.common_config("varsplat-tum", ("mapping.iterations=7",), 20.0)
    assert (config.tracking.tau, config.loops.tau, config.registration.tau) == (20.0, 20.0, 20.0)
    assert config.mapping.iterations == 7
    same = {name for name, value in flat(preset("varsplat-tum")).items() if flat(config)[name] == value}
    changed = {"tracking.tau", "loops.tau", "registration.tau", "mapping.iterations"}
    assert flat(config).keys() - same <= changed


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"sources": ()}, "no source given"),
        ({"sources": ("synthetic", "/no/such/place")}, "/no/such/place"),
        ({"tau": 0.0}, "--tau must be above 0, found 0"),
        ({"settings": ("loops.tau=5",)}, "the ablation itself sets loops.tau"),
        ({"settings": ("tracking.uncertainty=off",)}, "the ablation itself sets tracking.uncertainty"),
        ({"settings": ("seed=5",)}, "the ablation itself sets seed"),
        ({"settings": ("mapping.weight_nll_color=0",)}, "learns no variance"),
        ({"preset": "loopsplat-fast"}, "loopsplat-fast learns no variance"),
        ({"preset": "quick"}, "no preset 'quick'"),
    ],
    ids=str,
)
def test_refusals_are_one_line_and_leave_nothing(
    given: dict[str, Any], says: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    options = bench_ablation.Options(**{"sources": ("synthetic",), "runs": tmp_path, "out": tmp_path} | given)
    assert bench_ablation.main(options) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert says in said.err and said.err.startswith("ablation.py: ") and said.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_all_variants_of_a_seed_run_on_the_same_scene(tmp_path: Path) -> None:
    (tmp_path / "kitchen").mkdir()
    study = Study(("synthetic:seed={seed}", str(tmp_path / "kitchen")), BASE, seeds=2)
    made, real = (study.jobs(source) for source in study.sources)
    assert [(job.path, job.seed) for job in made] == [
        (f"synthetic:seed={seed}", seed) for seed in (0, 1) for _ in NAMES
    ]
    assert {job.path for job in real} == {str(tmp_path / "kitchen")}
    assert all(job.config.seed == job.seed for job in [*made, *real])
    assert len({job.folder for job in [*made, *real]}) == len({job.key for job in [*made, *real]}) == 20


def options_of(folder: Path, *sources: str, **given: Any) -> Any:
    """Return the options of an ablation in a folder, without the runs without variance."""
    return bench_ablation.Options(sources=sources, **{"runs": folder, "out": folder, "reference": False} | given)


def test_printed_and_stored_results_are_those_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runner = MadeUpRuns({"+loop": 0.005, "+registration": 0.005, "+final": 0.006})
    options = options_of(tmp_path, "room", "hall", reference=True)
    options.run(Screen(), runner)
    assert len(runner.jobs) == 2 * 3 * 6 and not any(folder.exists() for folder in runner.folders)
    said = capsys.readouterr().out
    assert "[36/36] hall, +final, seed 2" in said
    assert "room: +tracking against none: no figure differs in any run\n" in said
    on_the_rest = "no clear effect on PSNR before, PSNR after and depth L1"
    assert f"+loop against +tracking: helps ATE (−0.50 ± 0.00 cm); {on_the_rest}\n" in said
    assert f"hall: +final against +registration: harms ATE (+0.10 ± 0.00 cm); {on_the_rest}\n" in said
    assert "5% of figures do so by chance" in said

    written = json.loads(options.working_file().read_text())
    assert written["machine"]["cores"] and written["code"] == code_digest(Path(sigmasplat.__file__).parent, INSTALLED)
    assert Config.from_dict(written["config"]) == ablation.common_config("sigma", (), 10.0)
    run = next(r for r in written["runs"] if (r["source"], r["variant"], r["seed"]) == ("hall", "+loop", 2))
    assert run["figures"]["ate_m"] == pytest.approx(0.0052)
    assert run["metrics"] == metrics(0.0052, before=24.0)
    job = next(j for j in runner.jobs if (j.source, j.variant, j.seed) == ("hall", "+loop", 2))
    assert override(Config.from_dict(written["config"]), run["settings"] | {"seed": "2"}) == job.config


def test_an_interrupted_ablation_resumes_where_it_left_off(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options, first, second = options_of(tmp_path, "room"), MadeUpRuns(stop_at=4), MadeUpRuns()
    with pytest.raises(KeyboardInterrupt):
        options.run(Screen(), first)
    assert "4 of 15 runs are in" in capsys.readouterr().out
    assert len(json.loads(options.working_file().read_text())["runs"]) == 4
    options.run(Screen(), second)
    assert [job.key for job in first.jobs + second.jobs] == [job.key for job in options.study().jobs("room")]
    options_of(tmp_path, "room", seeds=4).run(Screen(), more := MadeUpRuns())
    assert [job.seed for job in more.jobs] == [3] * 5
    assert not list(tmp_path.glob(".*"))


def test_runs_of_other_settings_or_code_are_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def made(**given: Any) -> int:
        options_of(tmp_path, "room", seeds=1, **given).run(Screen(), runner := MadeUpRuns())
        return len(runner.jobs)

    assert (made(), made()) == (5, 0)
    for other in ({"tau": 20.0}, {"limit": 5}, {"settings": ("mapping.iterations=3",)}):
        assert (made(**other), made(**other)) == (5, 0)
    monkeypatch.setattr(ablation, "code_digest", lambda folder, endings: "another")
    assert (made(**other), made(**other)) == (5, 0)
    assert json.loads((tmp_path / "ablation.json").read_text())["code"] == "another"


@pytest.mark.parametrize("text", ["ten years of work", "[]", '{"runs": []}'])
def test_a_file_of_another_program_is_not_changed(text: str, tmp_path: Path) -> None:
    (tmp_path / "ablation.json").write_text(text)
    with pytest.raises(RunError, match=r"ablation\.json.*give another --name"):
        options_of(tmp_path, "room").run(Screen(), MadeUpRuns())
    assert (tmp_path / "ablation.json").read_text() == text


def test_run_folders_stay_only_in_the_keep_folder(tmp_path: Path) -> None:
    study, runner = Study(("room",), BASE, seeds=2), MadeUpRuns()
    run_jobs(study.jobs("room"), Results(tmp_path / "a.json", study), runner, tmp_path / "kept", lambda job: None)
    assert sorted(tmp_path.joinpath("kept").iterdir()) == sorted(runner.folders) and len(set(runner.folders)) == 10


def test_the_code_digest_depends_on_code_files_only(tmp_path: Path) -> None:
    (tmp_path / "kernel.so").write_bytes(b"1")
    first = code_digest(tmp_path, INSTALLED)
    (tmp_path / "notes.txt").write_text("no code")
    assert code_digest(tmp_path, INSTALLED) == first
    (tmp_path / "kernel.so").write_bytes(b"2")
    assert code_digest(tmp_path, INSTALLED) != first


def test_a_map_without_refinement_has_one_psnr() -> None:
    assert figures_of(metrics(None, before=None, after=24.5)) == {
        "ate_m": None, "psnr_before_db": None, "psnr_db": 24.5, "depth_l1_m": 0.02, "loops": 1, "lost": 0,
        "frames_per_s": 12.5,
    }  # fmt: skip
    assert [f.title for f in columns(runs_of(a=[0.01]))] == ["ATE", "PSNR", "depth L1", "loops", "lost", "frames/s"]
    refined = [{"figures": figures_of(metrics(before=24.0))}]
    assert [f.title for f in columns(refined)][1:3] == ["PSNR before", "PSNR after"]


def test_differences_are_judged_at_equal_seeds() -> None:
    """Scenes differ far more than variants; at equal seeds the gain is 1 mm each time."""
    runs = runs_of(a=[0.01, 0.05, 0.09], b=[0.009, 0.0491, 0.0889], c=[0.02, 0.03, 0.10], d=[0.011, 0.0511, 0.0911])
    ate = {name: paired_differences(runs, name, "a")[0] for name in "bcd"}
    differences = 100 * np.subtract([0.009, 0.0491, 0.0889], [0.01, 0.05, 0.09])
    assert ate["b"].mean == pytest.approx(differences.mean()) and ate["b"].deviation == pytest.approx(
        differences.std(ddof=1)
    )
    assert [ate[name].verdict for name in "bcd"] == ["helps", "no clear effect", "harms"]
    assert ate["b"].written() == "−0.10 ± 0.01 cm"
    assert described(paired_differences(runs, "c", "a")) == "no clear effect"
    assert described(paired_differences(runs, "a", "a")) == "no figure differs in any run"
    assert described(paired_differences(runs, "nobody", "a")) == "nothing to compare"


def test_one_seed_and_missing_figures_are_not_judged() -> None:
    runs = runs_of(a=[0.01], b=[0.02])
    assert described(paired_differences(runs, "b", "a")) == "one seed is not enough to judge"
    runs = runs_of(a=[0.01, None, 0.03], b=[0.02, 0.01, None])
    assert paired_differences(runs, "b", "a")[0].deviation is None and paired_differences(runs, "b", "a")[
        0
    ].mean == pytest.approx(1.0)


def test_the_best_printed_mean_is_marked() -> None:
    ate, loops, speed = FIGURES[0], FIGURES[4], FIGURES[6]
    assert best({"a": 1.234, "b": 1.231, "c": 1.26}, ate) == {"a", "b"}
    assert best({"a": 1.234, "b": 1.231}, ate) == set()
    assert best({"a": 1.0, "b": 2.0}, loops) == set() and best({"a": 1.0, "b": 2.0}, speed) == {"b"}
    assert (spread([], 2), spread([2.0, 2.0], 2), spread([1.0], 2), spread([1.5], 2)) == ("–", "2", "1", "1.50")
    assert spread([1.0, 2.0], 2) == "1.50 ± 0.71"


@pytest.mark.slow
def test_real_runs_leave_figures_and_their_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("sigmasplat.native._core", reason="sigmasplat.native._core is not built")
    room = "synthetic:frames=120,width=64,height=48,seed={seed}"
    quick = ("input.width=64", "mapping.first_iterations=6", "mapping.iterations=4", "final.iterations=5")
    options = options_of(tmp_path, room, seeds=1, limit=4, settings=quick, keep=tmp_path / "kept")
    options.run(Screen())
    runs = json.loads(options.working_file().read_text())["runs"]
    assert [run["variant"] for run in runs] == list(NAMES)
    for run in runs:
        assert 0 < run["figures"]["ate_m"] < 0.05 and run["figures"]["psnr_db"] > 10 and run["figures"]["loops"] == 0
        assert run["metrics"]["frames"] == 4 and run["path"] == room.replace("{seed}", "0")
    folders = [RunFolder.open(path) for path in sorted((tmp_path / "kept").iterdir())]
    weights = sorted((c.tracking.uncertainty, c.loops.uncertainty) for c in (folder.config() for folder in folders))
    assert weights == [(False, False), (True, False), (True, True), (True, True), (True, True)]
    assert "one seed is not enough to judge" in capsys.readouterr().out


def test_committed_results_become_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record, "data_root", lambda: tmp_path)
    (tmp_path / "livingroom").mkdir()
    options = bench_ablation.Options(
        sources=("synthetic", "livingroom"), seeds=3, runs=tmp_path, out=tmp_path / "results"
    )
    assert options.study().sources == (bench_ablation.SYNTHETIC, str(tmp_path / "livingroom"))
    made_up = MadeUpRuns({"+loop": 0.005})
    monkeypatch.setattr(bench_ablation, "check_sources", lambda study, screen: None)
    monkeypatch.setattr(bench_ablation, "run_job", lambda job, folder, screen: made_up(job, folder))
    assert bench_ablation.main(options) == 0
    measured = record.latest("ablation", tmp_path / "results")
    assert (
        measured["seeds"] == [0, 1, 2]
        and len(measured["figures"]["runs"]) == 36
        and str(tmp_path) not in json.dumps(measured["figures"])
    )
    made = {s.title: s for s in tables.sections(measured)}
    assert list(made) == ["synthetic", "livingroom", "Effects", "Verdicts"]
    assert [row[0] for row in made["livingroom"].rows] == [WITHOUT_VARIANCE, *NAMES]
    assert made["livingroom"].rows[3][1] == "**0.51 ± 0.01**" and "3 worlds" in made["synthetic"].note
    assert made["Effects"].rows[2][:3] == ["synthetic", "+loop against +tracking", "**−0.50 ± 0.00 cm**"]
    verdicts = {row[0]: row[1:] for row in made["Verdicts"].rows}
    assert verdicts["+loop against +tracking"] == ["ATE (−49.5 ± 0.0 %)", "–"]
    assert verdicts["+registration against +loop"] == ["–", "ATE (+98.0 ± 0.0 %)"]
    assert verdicts["+tracking against none"] == ["–", "–"]
    assert all(len(row) == len(section.columns) for section in made.values() for row in section.rows)
    text, missing = tables.rewritten("<!-- bench:ablation/livingroom -->\n<!-- /bench -->", tmp_path / "results")
    assert missing == [] and "| +loop | **0.51 ± 0.01** |" in text


def test_the_benchmark_refuses_in_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    options = bench_ablation.Options(sources=("/no/such/place",), runs=tmp_path, out=tmp_path)
    assert bench_ablation.main(options) == 2
    assert capsys.readouterr().err.startswith("ablation.py: no such folder") and not list(tmp_path.iterdir())
