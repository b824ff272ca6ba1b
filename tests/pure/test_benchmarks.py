"""The benchmarks: their programs start, their arithmetic is right, their tables say what was measured."""

import importlib
import json
import re
import runpy
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from benchmark_results import BENCHMARKS, laid_out, results
from paper_settings import RenderConfig
from sigmasplat import cli
from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.fit.pose import PoseFit
from sigmasplat.native import _core
from sigmasplat.plugins.sources import open_source
from sigmasplat.render import reference, render
from sigmasplat.tracking.tracker import Tracker

accuracy, accuracy_tables, cpu, cpu_scene, cpu_tables, record, scenes, tables, works = map(
    importlib.import_module,
    ("accuracy", "accuracy_tables", "cpu", "cpu_scene", "cpu_tables", "record", "scenes", "tables", "works"),
)
program, tracking, tracking_tables = map(importlib.import_module, ("program", "tracking", "tracking_tables"))
ROOM = "synthetic:frames=200,width=64,height=48"


@pytest.fixture
def kernel_settings() -> Iterator[None]:
    """Put instruction set and threads back as they were."""
    isa, threads, torch_threads = _core.isa_name(), _core.threads(), torch.get_num_threads()
    yield
    _core.set_isa(isa)
    _core.set_threads(threads)
    torch.set_num_threads(torch_threads)


def job_result(source: str, seed: int, problem: str | None = None, **figures: float | None) -> dict[str, Any]:
    job = {"source": source, "preset": accuracy_tables.GOAL_PRESET, "seed": seed}
    return {"job": job, "problem": problem, "peak_mib": 512.0, "figures": figures}


def test_every_program_explains_itself(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    words = {"cpu": "--quick", "accuracy": "--seeds", "tracking": "--experiments", "tables": "--check",
             "loops": "--experiments", "long_run": "--scratch", "pose_gradient": "--refinement",
             "systems": "--presets", "consistency": "--variants", "ablation": "--no-reference"}  # fmt: skip
    parses = re.compile(r"^    .*\b(program\.start|tyro\.cli)\(.*(main|Options)", re.MULTILINE)
    last_lines = {path: path.read_text(encoding="utf-8").partition("__main__")[2] for path in BENCHMARKS.glob("*.py")}
    programs = [path for path, text in last_lines.items() if parses.search(text)]
    assert words.keys() <= {path.stem for path in programs}
    for path in programs:
        monkeypatch.setattr(sys, "argv", [str(path), "--help"])
        with pytest.raises(SystemExit) as left:
            runpy.run_path(str(path), run_name="__main__")
        said = capsys.readouterr()
        assert left.value.code == 0, f"{path.name}: {said.err}"
        assert said.out.startswith("usage: ") and words.get(path.stem, "--help") in said.out, path.name
        assert "example: " in said.out or path.stem not in ("systems", "consistency", "peers", "picture")


def test_machines_have_file_names() -> None:
    xeon = {"cpu": "Intel(R) Xeon(R) CPU @ 2.50GHz", "cores": 2}
    assert record.machine_slug(xeon) == "intel-xeon-cpu-2-50ghz-2-cores"
    assert record.slug("…") == "unknown"


def test_code_digest_sees_names_and_bytes_of_code_only(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("x = 1")
    digests = [record.code_digest(tmp_path)]
    (tmp_path / "notes.md").write_text("not code")
    assert record.code_digest(tmp_path) == digests[0]
    (tmp_path / "a.py").write_text("x = 2")
    digests.append(record.code_digest(tmp_path))
    (tmp_path / "a.py").rename(tmp_path / "b.py")
    digests.append(record.code_digest(tmp_path))
    assert len(set(digests)) == 3


def test_latest_is_the_newest_of_the_very_name(tmp_path: Path) -> None:
    for name, cpu_name, day in (("cpu", "old", "01"), ("cpu", "new", "03"), ("cpu-small", "new", "09")):
        machine = {"cpu": cpu_name, "cores": 1}
        measured = results("cpu", {}, name=name, machine=machine, date=f"2025-01-{day}")
        assert record.read(record.write(measured, tmp_path)) == measured
    assert record.latest("cpu", tmp_path)["date"] == "2025-01-03"
    assert record.latest("cpu-old-1-cores", tmp_path)["date"] == "2025-01-01"
    assert record.latest("gpu", tmp_path) is None


@dataclass(frozen=True)
class Writing:
    out: Path
    quick: bool = False


def test_a_benchmark_checks_first_that_it_can_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    started: list[Path] = []

    def main(options: Writing) -> int:
        started.append(options.out)
        return 3

    def exit_code(*words: str) -> Any:
        monkeypatch.setattr(sys, "argv", ["some_benchmark.py", *words])
        with pytest.raises(SystemExit) as left:
            program.start(main, Writing)
        return left.value.code

    within = str(tmp_path / "file" / "results")
    assert exit_code("--out", within) == 2 and started == []
    said = capsys.readouterr().err
    assert said.startswith("some_benchmark.py: results cannot be written to ") and said.count("\n") == 1
    assert exit_code("--out", within, "--quick") == 3  # it writes nothing
    assert exit_code("--out", str(tmp_path / "new")) == 3 and list((tmp_path / "new").iterdir()) == []


def test_figures_have_three_digits() -> None:
    texts = {6.4312: "6.43", 12.08: "12.1", 1189.6: "1190", 0.0123456: "0.0123", 0.0: "0.00", -2.5: "-2.50",
             999.9: "1000", None: "–", float("nan"): "–"}  # fmt: skip
    assert {value: tables.significant(value) for value in texts} == texts


def test_blocks_are_rewritten_and_nothing_else(tmp_path: Path) -> None:
    measured = results("accuracy", {"jobs": [job_result("synthetic", 0, ate_m=0.00512, held_out_psnr_db=31.4)]})
    record.write(measured, tmp_path)
    text = "before\n<!-- bench:accuracy/path-and-speed -->\nold\n<!-- /bench -->\nafter <!-- bench -->\n"
    new, missing = tables.rewritten(text, tmp_path)
    assert missing == []
    assert new.startswith("before\n<!-- bench:accuracy/path-and-speed -->\n")
    assert new.endswith("<!-- /bench -->\nafter <!-- bench -->\n")
    assert "old" not in new and "| synthetic | sigma | 1 | 0.512 |" in new and "31.4" not in new
    assert "commit 012345678 with changes" in new
    assert tables.rewritten(new, tmp_path) == (new, [])
    unmeasured = "<!-- bench:gpu/times-ms -->\nold\n<!-- /bench -->"
    assert tables.rewritten(unmeasured, tmp_path) == (unmeasured, ["gpu"])
    with pytest.raises(KeyError, match="nothing"):
        tables.rewritten("<!-- bench:accuracy/nothing -->\n<!-- /bench -->", tmp_path)


def timing(**works_ms: float) -> dict[str, dict[str, float]]:
    return {name: {"median_ms": ms, "min_ms": 0.9 * ms, "runs": 7} for name, ms in works_ms.items()}


def scene(splats: int, width: int, ms: float, **changes: Any) -> dict[str, Any]:
    works_ms = timing(forward_all=ms, forward_color_depth=0.6 * ms, mapping_iteration=3 * ms)
    timings = [
        {"isa": isa, "threads": threads, "works": timing(forward_all=factor * ms) if factor != 1 else works_ms}
        for isa, threads, factor in (("avx512", 2, 1), ("avx512", 1, 1.9), ("avx2", 2, 1.6))
    ]
    size = {"splats": splats, "width": width, "height": width * 3 // 4}
    pairs = {"pairs": 3e6, "pairs_standard_error": 1e5, "pairs_sampled_pixels": 400}
    memory = {"before_mib": 300.0, "peak_mib": 350.0}
    return {**size, **pairs, "memory": memory, "timings": timings, "peer": None, **changes}


def test_exponents_goals_and_ratios_follow_from_the_times() -> None:
    assert cpu_tables.exponent(2.0, 2.0 * 15**1.3, 20.0, 300.0) == pytest.approx(1.3)
    figures = {
        "source": "x",
        "scenes": [scene(20_000, 320, 2.0), scene(77_000, 320, 6.0), scene(77_000, 640, 24.0)],
        "reference": {"compared": []},
    }
    made = laid_out("cpu", figures)
    held = {row[0]: (row[2], row[3]) for row in made["Goals"].rows}
    assert held["forward, all outputs, 77 k, 320×240"] == ("6.00", "yes")
    assert held["colour + depth / all outputs, forward, 77 k, 320×240"] == ("0.600", "yes")
    assert held["1 → 2 threads, forward, all outputs, 77 k, 320×240"] == ("1.90", "yes")
    assert held["avx2 / avx512, forward, all outputs, 77 k, 320×240"] == ("1.60", "**no**")
    assert held["exponent, 77 k, 320×240 → 77 k, 640×480, forward, all outputs"] == ("1.00", "yes")
    assert made["Work"].rows[1][3] == "0.500"  # 3 M pairs in 6 ms
    assert "Plain torch" not in made and "Peer" not in made


def test_seeds_are_summed_up_as_mean_and_sample_deviation() -> None:
    assert accuracy_tables.mean_std([1.0, 2.0, 3.0]) == (2.0, 1.0)
    assert accuracy_tables.mean_std([4.0]) == (4.0, None)
    assert [accuracy_tables.spread(v) for v in ([1.0, 2.0, 3.0], [5.0, 5.0], [0.25], [])] == [
        "2.00 ± 1.0", "5", "0.250", "–",
    ]  # fmt: skip


def test_a_goal_is_held_by_every_seed_of_a_whole_run_or_not_at_all() -> None:
    jobs = [
        job_result("livingroom", 0, ate_m=0.005, spearman=0.4),
        job_result("livingroom", 1, ate_m=0.02, spearman=0.3),
        job_result("livingroom", 2, problem="sigmasplat: a | b", ate_m=0.9),
    ]
    made = laid_out("accuracy", {"jobs": jobs})
    held = {row[0]: row[1:] for row in made["Goals"].rows}
    assert held["livingroom: ATE ≤ 1 cm"] == ["0.500, 2.00", "**no**"]
    assert held["livingroom: Spearman > 0"] == ["0.400, 0.300", "yes"]
    assert made["Path and speed"].rows[0][2:4] == ["2", "1.25 ± 1.1"]
    assert list(made["Failed"].rows) == [["livingroom, sigma, seed 2", "sigmasplat: a / b"]]
    for config in ({"limit": 5}, {"settings": ["mapping.iterations=5"]}):
        assert "Goals" not in laid_out("accuracy", {"jobs": jobs}, config=config)


def test_figures_are_picked_from_metrics_where_there_are_any() -> None:
    metrics = {
        "ate": {"rmse_m": 0.01},
        "rpe": None,
        "frames": 5,
        "held_out": {"psnr_db": 30.0, "ssim": None},
        "uncertainty": {"ause": 0.7},
    }
    picked = accuracy.figures_of(metrics)
    assert (picked["ate_m"], picked["frames"], picked["held_out_psnr_db"], picked["ause"]) == (0.01, 5, 30.0, 0.7)
    assert picked["rpe_m"] is picked["held_out_ssim"] is picked["training_psnr_db"] is picked["spearman"] is None
    shown = {name for _, name, _ in (*accuracy_tables.PLACE, *accuracy_tables.PICTURES)}
    assert shown - {"peak_mib"} <= set(picked)


def test_a_job_is_taken_from_before_only_if_nothing_changed(tmp_path: Path) -> None:
    def job(**changes: Any) -> Any:
        usual = {"source": "s", "path": "p", "preset": "varsplat-fast", "seed": 0, "settings": (), "limit": 5}
        return accuracy.Job(**{**usual, "code": "abc", **changes})

    folder = job().folder(tmp_path)
    folder.mkdir()
    result = {"key": job().key(), "problem": None}
    (folder / "result.json").write_text(json.dumps(result))
    assert accuracy.finished(job(), tmp_path) == result
    for change in ({"code": "abd"}, {"seed": 1}, {"limit": 6}, {"settings": ("mapping.iterations=5",)}, {"path": "q"}):
        assert accuracy.finished(job(**change), tmp_path) is None, change
    (folder / "result.json").write_text(json.dumps(result | {"problem": "lost its way"}))
    assert accuracy.finished(job(), tmp_path) is None
    with pytest.raises(ConfigError):
        accuracy.jobs_of(accuracy.Options(presets=("varsplat-nothing",)))


def test_a_failed_run_is_reported_and_leaves_no_result_to_reuse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = accuracy.Job("nothere", "p", "varsplat-fast", 0, (), 2, "abc")
    script = "print('one'); print('sigmasplat: no such folder'); print(); raise SystemExit(2)"
    monkeypatch.setattr(accuracy.Job, "command", lambda self, run: [sys.executable, "-c", script])
    result = accuracy.perform(job, tmp_path)
    assert result["problem"] == "sigmasplat: no such folder" and result["figures"] == {}
    assert result["peak_mib"] > 1 and accuracy.finished(job, tmp_path) is None


def test_a_job_is_what_the_command_line_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nowhere = str(tmp_path / "nowhere")
    settings = ("mapping.iterations=5", "tracking.method=adam")
    job = accuracy.Job("s", nowhere, "loopsplat-fast", 1, settings, 7, "abc")
    python, *module, command = job.command(tmp_path / "run")[:4]
    assert (python, module, command) == (sys.executable, ["-m", "sigmasplat.cli"], "run")
    with pytest.raises(SystemExit):
        cli.main(job.command(tmp_path / "run")[3:])
    assert f"no such folder or file: {nowhere}" in capsys.readouterr().err  # every option was understood
    assert job.key()["config"]["mapping"]["iterations"] == 5 and job.key()["config"]["seed"] == 1


def stack(opacities: list[float]) -> GaussianField:
    """Put small splats one behind the other on the axis of a camera with its centre at pixel (4, 3)."""
    n = len(opacities)
    means = torch.zeros(n, 3)
    means[:, 2] = 1.0 + 0.1 * torch.arange(n)
    scales, colors = torch.full((n,), 1e-4), torch.zeros(n, 3)
    return GaussianField.from_values(means, scales, colors, opacities=torch.tensor(opacities))


def test_pairs_obey_the_threshold_and_the_stop() -> None:
    for opacities, pairs in [([0.5] * 3, 3), ([0.95] * 6, 4), ([0.003, 0.5], 1), ([], 0)]:
        camera = Camera(9, 7, 8.0, 8.0, 4.0, 3.0)
        options = RenderConfig(low_pass_px2=0.01)  # one pixel each
        assert scenes.count_pairs(stack(opacities), camera, options, 63, np.random.default_rng(0)) == (pairs, 0.0)


def test_pairs_are_those_that_the_definition_blends() -> None:
    camera, options, random = Camera(24, 18, 20.0, 20.0, 11.5, 8.5), RenderConfig(), np.random.default_rng(3)
    means = torch.tensor(random.uniform([-1, -1, 1], [1, 1, 3], (300, 3)), dtype=torch.float32)
    scales = torch.tensor(random.uniform(0.02, 0.2, (300, 3)), dtype=torch.float32)
    field = GaussianField.from_values(means, scales, torch.zeros(300, 3), opacities=torch.full((300,), 0.7))
    p = reference.project(field.means, field.quats, field.scales, torch.eye(4), camera, options)
    features = torch.zeros(300, 1, requires_grad=True)
    blended = reference.blend(*p, field.opacities, features, None, camera, options)
    counted = sum(
        int((torch.autograd.grad(pixel, features, retain_graph=True)[0] > 0).sum()) for pixel in blended.sums.flatten()
    )
    exact, _ = scenes.count_pairs(field, camera, options, 24 * 18, random)
    assert exact == pytest.approx(counted, rel=1e-3)
    estimate, error = scenes.count_pairs(field, camera, options, 200, random)
    assert 0 < error < 0.2 * counted and abs(estimate - counted) < 4 * error


def test_splats_lie_on_the_surface_that_the_frame_sees() -> None:
    made = scenes.make_scene(ROOM, 20, 500, 32)
    assert len(made.field) == 500 and made.frames == 1 and (made.camera.width, made.camera.height) == (32, 24)
    assert float(made.field.opacities.min()) > 0.5 and float(made.field.opacities.max()) < 0.99
    frame = open_source(ROOM).frame(20)
    p = reference.project(
        made.field.means, made.field.quats, made.field.scales, torch.eye(4), frame.camera, RenderConfig()
    )
    u, v = p.means2d.detach().numpy().round().astype(int).T
    np.testing.assert_allclose(p.z.detach().numpy(), frame.depth_m[v, u], rtol=1e-5)
    np.testing.assert_allclose(made.field.colors.numpy(), frame.color[v, u], rtol=1e-6)


def test_neighbours_lend_splats_in_the_first_frames_place() -> None:
    source = open_source(ROOM)
    truth = source.truth().T_world_camera
    readings = int((source.frame(20).depth_m > 0).sum())
    points, colors, frames = scenes.gather(source, 20, readings + 500, np.random.default_rng(0))
    assert frames > 1 and points.shape == colors.shape == (readings + 500, 3)
    lent = source.frame(25)
    T_first_lent = np.linalg.inv(truth[20]) @ truth[25]
    whole = (lent.camera.rays() * lent.depth_m[..., None]).reshape(-1, 3) @ T_first_lent[:3, :3].T + T_first_lent[:3, 3]
    nearest = np.linalg.norm(points[-100:, None] - whole[None], axis=2).min(1)
    assert np.median(nearest) < 0.05
    with pytest.raises(SourceError, match="asked for"):
        scenes.gather(open_source(ROOM, limit=22), 20, 20 * readings, np.random.default_rng(0))


def test_a_scene_is_measured_whole_and_laid_out(kernel_settings: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(works, "ADAM_ITERATIONS", 2)
    request = cpu_scene.Request(ROOM, 20, 300, 64, 2, tuple(_core.supported_isas()), (1,), 0)
    measured = cpu_scene.measure(request)
    compared = cpu_scene.compare_reference(request, 100)["compared"]
    figures = {"source": "room", "scenes": [measured], "reference": {"compared": compared}}
    made = laid_out("cpu", figures)
    assert [t["isa"] for t in measured["timings"]] == _core.supported_isas()
    assert set(measured["stages_ms"]) == set(works.STAGES) and min(measured["stages_ms"].values()) > 0
    assert len(made["Times, ms"].rows[0]) == len(made["Times, ms"].columns) == 1 + len(cpu_tables.COLUMNS)
    assert "–" not in made["Times, ms"].rows[0]
    assert len(made["Plain torch"].rows) == 2


def ours(means: Any, quats: Any, scales: Any, opacities: Any, colors: Any, K: Any, T: Any, w: int, h: int) -> Any:
    """Stand in for a peer: our own renderer, called as a peer is."""
    field = GaussianField.from_values(means, scales, colors, quats=quats, opacities=opacities)
    fx, fy, cx, cy = (float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return render(field, Camera(w, h, fx, fy, cx, cy), T, backend="cpu").color


def blank(*arguments: Any) -> Any:
    """Stand in for a peer that draws nothing."""
    return torch.zeros(arguments[-1], arguments[-2], 3)


def test_a_peer_gets_the_same_splats(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "a_peer", sys.modules[__name__])
    made = scenes.make_scene(ROOM, 20, 300, 64)
    same, other = (cpu_scene.time_peer(f"a_peer:{name}", made, 1) for name in ("ours", "blank"))
    assert same["mean_color_difference"] < 1e-6 < 0.05 < other["mean_color_difference"]
    assert same["forward"]["runs"] == 1
    for wrong in ("a_peer", ":f", "a_peer:"):
        with pytest.raises(ValueError, match="module:function"):
            cpu_scene.load_peer(wrong)


def test_the_quick_way_is_a_part_of_the_whole() -> None:
    options = cpu.Options(source=ROOM, splats=(300_000, 20_000, 77_000), isas=("baseline",), threads=(1,))
    whole = cpu.wanted(options)
    assert [(r["splats"], r["width"]) for r in whole[:3]] == [(20_000, 320), (77_000, 320), (300_000, 320)]
    quick = cpu.wanted(replace(options, quick=True))
    assert [(r["splats"], r["width"], r["runs"]) for r in quick] == [(20_000, 320, 7), (77_000, 320, 7)]


def test_errors_drawn_from_their_covariance_are_covered_and_from_a_wider_one_are_not() -> None:
    random = np.random.default_rng(0)
    roots = random.normal(size=(4000, 6, 6)) * [1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4]
    covariances = np.swapaxes(roots, 1, 2) @ roots + np.diag([1e-8] * 3 + [1e-10] * 3)
    twists = (np.linalg.cholesky(covariances) @ random.normal(size=(4000, 6, 1)))[..., 0]
    right = tracking_tables.coverage(twists, covariances)
    assert right["inside"] == pytest.approx(0.95, abs=0.012) and right["mean_nees"] == pytest.approx(6.0, rel=0.03)
    assert right["inside"] + right["below"] + right["above"] == pytest.approx(1.0)
    np.testing.assert_allclose(right["z_std"], 1.0, atol=0.04)
    for factor, where in ((0.25, "above"), (25.0, "below")):
        wrong = tracking_tables.coverage(twists, factor * covariances)
        assert wrong["mean_nees"] == pytest.approx(right["mean_nees"] / factor)
        assert wrong[where] > 0.5 > wrong["inside"]


def test_a_pairs_error_is_that_of_the_motion() -> None:
    T = se3.exp(np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.6]))
    off = se3.exp(np.array([0.003, 0.0, 0.004, 0.0, 0.0, 0.0])) @ se3.exp(np.array([0, 0, 0, 0.0, np.radians(2.0), 0]))
    error = tracking.relative_error(T @ off, T)
    assert error == {"translation_cm": pytest.approx(0.5), "rotation_deg": pytest.approx(2.0)}


def test_starts_have_their_frames_before_and_after() -> None:
    options = tracking.Options(source=ROOM, starts=4, gaps=(1, 5), before=3)
    assert tracking.spread(100, options) == [2, 33, 63, 94]
    assert tracking.spread(9, options) == [2, 3]
    with pytest.raises(SourceError, match="too few"):
        tracking.spread(7, options)


def test_pairs_are_fitted_on_a_fresh_keyframe_and_held_against_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracking.Options, "config", small_config)
    options = tracking.Options(source=ROOM, starts=2, gaps=(1, 3), before=3, iterations=3)
    found = tracking.measure_pairs(ROOM, options)
    assert (found["starts"], found["lost"], len(found["pairs"])) == ([2, 196], 0, 2 * 2 * 5)
    truth = open_source(ROOM).truth().T_world_camera
    moved = [100 * np.linalg.norm(truth[s + g][:3, 3] - truth[s][:3, 3]) for s in (2, 196) for g in (1, 3)]
    guesses = [pair["translation_cm"] for pair in found["pairs"] if pair["method"] == "guess"]
    np.testing.assert_allclose(guesses, moved, atol=1e-4)
    aligned = [pair["translation_cm"] for pair in found["pairs"] if pair["method"] == "keyframe"]
    assert max(np.divide(aligned, guesses)) < 0.5
    made = laid_out("tracking", {"pairs": found})
    assert len(made["Pairs"].rows) == 2 * 5 and len(made["Ratios"].rows) == 2 * 2
    assert all(len(row) == len(section.columns) for section in made.values() for row in section.rows)


def small_config(options: Any, seed: int) -> Config:
    """Return settings for tiny images and hardly any mapping."""
    settings = {"mapping.iterations": "2", "mapping.first_iterations": "5", "input.width": "64", "seed": str(seed)}
    return override(preset("varsplat-fast"), settings)


def test_a_followed_pose_has_the_error_of_its_own_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses that are off by a known twist in the live camera come back as that twist, whatever mapping moves."""
    known, claimed = np.array([1e-3, -2e-3, 3e-3, 1e-3, 2e-3, -1e-3]), np.diag([1e-6] * 6)
    pair = SimpleNamespace(reference=SimpleNamespace(points=np.zeros((0, 3))))
    covering = SimpleNamespace(covariance=claimed, bias=np.zeros(6), depth_m=1.0, pair=pair)
    source = open_source(ROOM, limit=8)
    T_world_room = se3.inverse(source.truth().T_world_camera[0])

    def off(self: Tracker, field: Any, view: Any, seen_now: Any) -> PoseFit:
        i = len(seen) + 1
        seen.append(i)
        T_camera_world = se3.inverse(T_world_room @ source.truth().T_world_camera[i])
        return PoseFit(se3.exp(known) @ T_camera_world, 1.0, 1.0, 0.0, 0.0, 1, covering)  # type: ignore[arg-type]

    seen: list[int] = []
    monkeypatch.setattr(Tracker, "track", off)
    config = override(
        small_config(None, 0),
        {"mapping.lr_pose_translation": "0", "mapping.lr_pose_rotation": "0", "mapping.overlap_below": "0"},
    )
    twists, covariances, ages, lost = tracking.follow(source, config)
    assert (lost, ages.tolist()) == (0, [1, 2, 3, 4, 5, 1, 2])
    np.testing.assert_allclose(twists[:5], np.tile(known, (5, 1)), atol=1e-9)  # their keyframe is the first, exact
    assert np.abs(twists[5:]).max() < 5e-3 and (covariances == claimed).all()


def test_a_room_is_followed_with_covariances_and_laid_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracking.Options, "config", small_config)
    found = tracking.measure_consistency(ROOM, tracking.Options(source=ROOM, limit=8, seeds=(0, 1)))
    assert found["lost"] == 0 and found["all"]["frames"] == 14
    assert sum(part["frames"] for part in found["by_age"].values()) == 14
    made = laid_out("tracking", {"consistency": [found]})
    assert len(made["Consistency"].rows) == 1 + len(found["by_age"]) and len(made["Components"].rows) == 6
    with pytest.raises(SourceError, match="with a covariance"):
        descent = override(small_config(None, 0), {"tracking.method": "adam", "tracking.iterations": "1"})
        monkeypatch.setattr(tracking.Options, "config", lambda options, seed: descent)
        tracking.measure_consistency(ROOM, tracking.Options(source=ROOM, limit=2))


def pair(gap: int, method: str, cm: float, deg: float, ms: float) -> dict[str, Any]:
    return {"gap": gap, "method": method, "translation_cm": cm, "rotation_deg": deg, "ms": ms}


def test_alignment_is_held_to_the_better_rates_of_each_column() -> None:
    found = [
        pair(2, "guess", 9.0, 9.0, 0.0),
        pair(2, "adam TUM", 1.0, 0.4, 500.0),
        pair(2, "adam Replica", 2.0, 0.2, 400.0),
        *(pair(2, "keyframe", cm, 0.21, 10.0) for cm in (1.0, 1.05, 7.0)),
        pair(2, "map", 1.2, 0.1, 30.0),
    ]
    figures = {"pairs": {"source": "x", "starts": [3], "lost": 0, "pairs": found}}
    made = laid_out("tracking", figures)
    assert [row[2:] for row in made["Ratios"].rows] == [["1.05", "1.05", "40.0"], ["1.20", "0.500", "13.3"]]
    names = [
        row[0].removeprefix("Gauss–Newton, ").replace(", 2 frames after the keyframe:", "")
        for row in made["Goals"].rows
    ]
    held = dict(zip(names, (row[3] for row in made["Goals"].rows), strict=True))
    assert held == {
        "keyframe translation error / Adam's": "yes", "keyframe rotation error / Adam's": "yes",
        "keyframe time / Adam's": "yes", "map translation error / Adam's": "**no**",
        "map rotation error / Adam's": "yes", "map time / Adam's": "**no**",
    }  # fmt: skip


def test_whole_runs_are_held_to_adam_by_the_better_rates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ate_m = {"align": 0.025, "adam TUM": 0.03, "adam Replica": 0.01}

    def ran(jobs: list[Any], options: Any) -> list[dict[str, Any]]:
        asked.extend(jobs)
        config = jobs[0].key()["config"]["tracking"]
        method = {2e-3: "adam TUM", 2e-4: "adam Replica"}[config["lr_rotation"]]
        method = "align" if config["method"] == "align" else method
        return [job_result(job.source, job.seed, ate_m=ate_m[method]) | {"wall_s": 1.0} for job in jobs]

    asked: list[Any] = []
    monkeypatch.setattr(accuracy, "run_all", ran)
    options = tracking.Options(source=ROOM, sources=("s",), seeds=(0, 1), iterations=7, limit=20, runs=tmp_path)
    jobs = tracking.measure_sequences(options)
    assert [(job["method"], job["seed"]) for job in jobs] == [(method, seed) for method in ate_m for seed in (0, 1)]
    assert {job.limit for job in asked} == {20}
    assert [job.key()["config"]["tracking"]["iterations"] for job in asked[2:]] == [7] * 4
    made = laid_out("tracking", {"sequence": jobs})
    assert [row[:4] for row in made["Sequence"].rows] == [
        ["s", "Gauss–Newton", "2", "2.50 ± 0.0"],
        ["s", "Adam, TUM's rates", "2", "3"],
        ["s", "Adam, Replica's rates", "2", "1"],
    ]
    assert list(made["Goals"].rows) == [["s: ATE, cm; goal: that of the better Adam", "2.50", "≤ 1.00", "**no**"]]
    failed = [{**job, "problem": "a | b"} for job in jobs[:2]] + jobs[2:]
    made = laid_out("tracking", {"sequence": failed})
    assert "Goals" not in made and len(made["Failed"].rows) == 2


def test_the_summary_copies_cells_of_tables_and_names_what_is_missing(tmp_path: Path) -> None:
    summary = importlib.import_module("summary")
    measured = results("accuracy", {"jobs": [job_result("synthetic", 0, ate_m=0.00512), job_result("livingroom", 0)]})
    record.write(measured, tmp_path)
    found = summary.Results(tmp_path)
    assert found.cell("accuracy", "Path and speed", ("synthetic", "sigma"), "ATE, cm") == "0.512"
    with pytest.raises(KeyError, match="redkitchen"):
        found.cell("accuracy", "Path and speed", ("redkitchen", "sigma"), "ATE, cm")
    with pytest.raises(KeyError, match="systems"):
        found.cell("systems", "synthetic", ("finish, s",), "sigma")
