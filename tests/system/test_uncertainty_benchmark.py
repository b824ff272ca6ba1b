"""benchmarks/uncertainty.py: statistics of splats, predictors, temperatures, and the command on a tiny room."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import uncertainty
from finished_run import FinishedRun, aligned_poses, run_slam
from splat_statistics import (
    MapFacts,
    TrainingView,
    fisher,
    map_facts,
    ridge,
    splat_values,
)
from surface_errors import surface_errors
from surface_predictors import SURFACE_PREDICTORS
from uncertainty_samples import (
    EXACT,
    FUSED,
    HELD_BACK,
    MESH,
    Job,
    Kind,
    Samples,
    Study,
    measure,
)
from uncertainty_scores import (
    ALL,
    COVERED,
    VISIBLE,
    Run,
    score_runs,
    sparsification_charts,
)
from unseen_views import held_back_views
from view_predictors import PREDICTORS, see

from paper_settings import RenderConfig
from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.plugins.evaluation.metrics.uncertainty import sparsification
from sigmasplat.plugins.sources import open_source
from sigmasplat.render import FieldRenderer, reference
from sigmasplat.render.backend import make_view
from sigmasplat.run.scene import open_scene
from small_room import frame_at, walk

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

ROOM = "synthetic:frames=200,width=96,height=72,noise=1,test_views=2,seed={seed}"
QUICK = (
    "mapping.first_iterations=30",
    "mapping.iterations=8",
    "final.iterations=20",
    "mapping.every=2",
    "input.width=96",
)
OPTIONS = RenderConfig()


@pytest.fixture(scope="module")
def frame_map() -> MapFacts:
    """A map of one splat per fourth pixel of a frame, with that frame and its neighbours as training views."""
    frame = frame_at(0)
    v, u = (g.ravel() for g in np.mgrid[0:120:4, 0:160:4])
    z, camera = frame.depth_m[v, u], frame.camera
    means = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)
    field = GaussianField.from_values(
        torch.as_tensor(means).float(), torch.as_tensor(3.0 * z / camera.fx).float(),
        torch.as_tensor(frame.color[v, u]).float(), opacities=0.95,
    )  # fmt: skip
    view, renderer = make_view("cpu", camera, OPTIONS, variance=False), FieldRenderer(OPTIONS, "cpu")
    size, poses = (view.alpha.shape[0], view.alpha.shape[1]), walk().truth().T_world_camera
    keyframes = [
        Keyframe(i, Target.of(frame_at(i), size), se3.inverse(poses[0]) @ poses[i], fixed=True) for i in (0, 2, 4)
    ]
    return map_facts(field, keyframes, renderer)


def test_facts_are_those_of_the_keyframes(frame_map: MapFacts) -> None:
    assert len(frame_map.views) == 3
    pixels = np.stack([frame_at(i).color for i in (0, 2, 4)]).reshape(-1, 3)
    assert frame_map.prior[0] == pytest.approx(pixels.var(0).mean(), rel=0.05)
    assert 0.0 < frame_map.noise[0] < frame_map.prior[0] and 0.0 < frame_map.noise[1] < frame_map.prior[1]


def test_every_predictor_is_finite_and_not_negative(frame_map: MapFacts) -> None:
    turned = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.6, 0.0]))  # part of the view is empty
    seen = see(frame_map, splat_values(frame_map), frame_at(0).camera, turned, FieldRenderer(OPTIONS, "cpu"))
    assert float(seen.rendered.alpha.min()) == 0.0
    for predictor in PREDICTORS:
        plane = predictor.plane(seen)
        assert plane.shape == seen.rendered.alpha.shape, predictor.name
        assert torch.isfinite(plane).all() and float(plane.min()) >= 0.0, predictor.name
        assert float(plane.max()) > 0.0, predictor.name


def test_ridge_regression_finds_values_that_explain_the_errors(frame_map: MapFacts) -> None:
    true = torch.rand(len(frame_map.field), 2, generator=torch.Generator().manual_seed(0)) * 0.01
    views = [
        TrainingView(
            v.T_camera_map, *frame_map.blended(v.T_camera_map, true).values.contiguous().unbind(-1), v.depth_known
        )
        for v in frame_map.views
    ]
    facts = replace(frame_map, views=views, noise=(0.01, 0.01))
    found = ridge(facts)
    for k, name in enumerate(("ridge_color", "ridge_depth")):
        known = views[0].depth_known > 0
        got = frame_map.rendered(views[0].T_camera_map, found)[name][known]
        want = (views[0].color_error2, views[0].depth_error2)[k][known]
        assert float((got - want).square().mean()) < 0.2 * float(want.var()), name


def test_information_is_the_sum_of_squared_weights(frame_map: MapFacts) -> None:
    """Against the weights of the definition in torch, for as many splats as it renders quickly."""
    few = GaussianField(frame_map.field.params[::40].clone())
    views = [frame_map.views[0]] * 60
    facts = replace(frame_map, field=few, views=views, noise=(0.02, 0.1), prior=(0.05, 1.0))
    T, camera, n = torch.as_tensor(views[0].T_camera_map), frame_map.camera, len(few)
    p = reference.project(few.means, few.quats, few.scales, T, camera, OPTIONS)
    weights = reference.blend(*p, few.opacities, torch.eye(n), None, camera, OPTIONS).sums.reshape(-1, n)
    want = 1.0 / (len(views) * weights.square().sum(0) / 0.02 + 1.0 / 0.05)
    got = fisher(facts)["fisher_color"]
    assert float((got / want).log().abs().median()) < 0.1
    assert float((got / want).log().abs().max()) < 0.6


def samples(scale: float, seed: int) -> dict[Kind, dict[str, np.ndarray]]:
    """Draw errors whose variance is `scale` times what every predictor says; every fifth pixel is not covered."""
    random = np.random.default_rng(seed)
    variance = np.exp(random.uniform(-9, -3, 20_000))
    error2 = scale * variance * random.normal(size=20_000) ** 2
    arrays = {
        "squared_error": error2,
        "alpha": np.where(np.arange(20_000) % 5, 1.0, 0.2),
        "reading": np.arange(20_000) % 2,
    }
    arrays |= {f"variance {p.name}": variance for p in PREDICTORS if p.quantity == "color"}
    return {Kind("color", "final", HELD_BACK): {name: values.astype(np.float32) for name, values in arrays.items()}}


def test_a_temperature_comes_from_the_other_sequences() -> None:
    runs = [Run("a", samples(4.0, 0)), Run("a", samples(5.0, 1)), Run("b", samples(9.0, 2)), Run("c", samples(1.0, 3))]
    kind = Kind("color", "final", HELD_BACK)
    found = [of_kind[kind][ALL]["predictors"]["V"] for of_kind in score_runs(runs)]
    assert [row["temperature"] for row in found] == pytest.approx([5.0, 5.0, 10 / 3, 6.0], rel=0.05)
    assert found[0]["best_scale"] == pytest.approx(4.0, rel=0.05)
    assert found[0]["after"]["nll"] < found[0]["before"]["nll"]
    assert found[0]["nll_at_best_scale"] < found[0]["after"]["nll"]
    assert [row["temperature_68"] for row in found] == pytest.approx([3.0, 3.0, 20 ** (1 / 3), 180 ** (1 / 3)], rel=0.1)


def test_one_sequence_is_scored_in_sample() -> None:
    kind = Kind("color", "final", HELD_BACK)
    (scores,) = score_runs([Run("a", samples(4.0, 0))])
    assert scores[kind][ALL]["in_sample"] and scores[kind][COVERED]["pixels"] == 16_000
    row = scores[kind][ALL]["predictors"]["V"]
    assert row["temperature"] == row["best_scale"] and row["after"]["auce"] < 0.01 < row["before"]["auce"]
    assert row["after_68"]["coverage_68"] == pytest.approx(0.6827, abs=0.001)


def test_a_constant_is_the_best_one() -> None:
    kind, drawn = Kind("color", "final", HELD_BACK), samples(4.0, 0)
    drawn[kind]["variance constant"] = np.full(20_000, 0.123, np.float32)
    row = score_runs([Run("a", drawn), Run("b", samples(1.0, 1))])[0][kind][ALL]["predictors"]["constant"]
    assert row["mean_variance"] == pytest.approx(row["mean_squared_error"], rel=1e-3)
    assert row["after"]["nll"] == pytest.approx(row["nll_at_best_scale"], abs=1e-4)


def quick_job(seed: int = 0) -> Job:
    config = override(preset("sigma"), dict(text.split("=") for text in QUICK))
    return Study((ROOM,), config, seeds=seed + 1, limit=13, hold_every=4).jobs()[seed]


@pytest.fixture(scope="module")
def run() -> FinishedRun:
    job = quick_job()
    source, config = open_scene(job.path, job.config, job.given)
    return run_slam(config, source)


def test_scored_views_are_not_in_the_map(run: FinishedRun) -> None:
    mapped = {frame for index in range(len(run.store)) for frame in run.store.load(index).frames}
    assert run.held_back == [3, 7, 11] and not mapped & set(run.held_back)
    source = open_source(quick_job().path, quick_job().config.input)
    views = held_back_views(run, source, 24)
    assert [view.frame.index for view in views] == [i for i in run.held_back if run.valid[i]] and views
    for view in views:
        assert view.exact
        np.testing.assert_array_equal(view.T_world_camera, run.path.T_world_camera[view.frame.index])
        exact = source.exact_depth_of(view.frame.index)
        np.testing.assert_array_equal(view.frame.depth_m, np.where(exact <= 8.0, exact, 0.0))


def test_samples_have_every_predictor_and_both_maps(run: FinishedRun) -> None:
    found = measure(run, open_source(quick_job().path, run.config.input), 24)
    views = {kind: arrays for kind, arrays in found.samples.items() if kind.quantity != "surface"}
    assert {(kind.quantity, kind.map, kind.views) for kind in views} == {
        (quantity, *of) for quantity in ("color", "depth") for of in (
            ("final", HELD_BACK), ("final", "away from the path"), ("submaps", HELD_BACK),
        )
    }  # fmt: skip
    for kind, arrays in views.items():
        names = {f"variance {p.name}" for p in PREDICTORS if p.quantity == kind.quantity}
        assert arrays.keys() == names | {"squared_error", "alpha", "reading"}
        assert len({len(values) for values in arrays.values()}) == 1
        assert all(np.isfinite(values).all() and values.min() >= 0.0 for values in arrays.values() if len(values))

    assert found.facts["frames"] == 13 and found.facts["held_back"] == 3 and found.facts["ate_m"] < 0.1
    poses, failures = found.facts["poses"], found.facts["failures"]
    assert poses["hops"]["count"] == found.facts["keyframes"] - 1 and poses["from_start"]["count"] == 12
    assert poses["windows"] is None and 0.0 < poses["hops"]["nees_mean"] < 100.0
    assert failures["frames"] == 13 and failures["off"] == 0


@pytest.mark.slow
def test_the_benchmark_writes_scores_tables_and_pictures(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def finished(config: Config, *_: object) -> FinishedRun:
        assert config == run.config
        return run

    monkeypatch.setattr(uncertainty, "run_slam", finished)
    options = uncertainty.Options(
        (ROOM,), settings=QUICK, seeds=1, limit=13, hold_every=4, views=3, name="tiny", runs=tmp_path, out=tmp_path
    )
    assert uncertainty.main(options) == 0
    text = capsys.readouterr().out
    assert "AUSE" in text and "V" in text and "The temperature T is that of the sequence itself" in text
    assert "keyframe to keyframe" in text and "AUROC" in text
    out = options.folder()
    (scored,) = json.loads((out / "uncertainty.json").read_text())["runs"]
    assert {"nees_mean", "coverage_90", "position_k"} <= scored["poses"]["from_start"].keys()
    row = scored["scores"]["color"]["final"][HELD_BACK]["all pixels"]["predictors"]["V + T prior"]
    assert {"ause", "spearman", "before", "after", "temperature"} <= row.keys()
    assert len(list(out.glob("*.svg"))) >= 4
    (samples_file,) = (out / "samples").iterdir()
    written = samples_file.stat().st_mtime_ns
    assert uncertainty.main(options) == 0
    assert samples_file.stat().st_mtime_ns == written, "a finished run is reused"


def test_mistakes_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(**given: object) -> str:
        assert uncertainty.main(uncertainty.Options(**{"runs": tmp_path, "name": "mine"} | given)) == 2
        return capsys.readouterr().err

    assert "no source" in refused(sources=())
    assert "input.hold_every" in refused(sources=("x",), settings=("input.hold_every=5",))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("not ours")
    assert "not empty" in refused(sources=(ROOM,))


def test_pixels_of_all_views_are_mixed() -> None:
    """A constant removes no error: its sparsification curve is flat, although the views differ in their errors."""
    drawn = Samples()
    for error2 in (0.01, 0.04, 0.09):
        drawn.squared_error.append(np.full(3000, error2, np.float32))
        drawn.alpha.append(np.ones(3000, np.float32))
        drawn.reading.append(np.ones(3000, np.float32))
        drawn.variances.setdefault("constant", []).append(np.ones(3000, np.float32))
    joined = drawn.joined()
    curve = sparsification(joined["variance constant"], joined["squared_error"], 20)
    np.testing.assert_allclose(curve, curve[0], rtol=0.05)


def test_a_surface_is_compared_with_the_true_one(run: FinishedRun) -> None:
    found = measure(run, open_source(quick_job().path, run.config.input), 1).samples[Kind("surface", MESH, EXACT)]
    names = {f"variance {p.name}" for p in SURFACE_PREDICTORS}
    assert found.keys() == names | {"squared_error", "alpha", "reading"}
    assert all(np.isfinite(values).all() and values.min() >= 0.0 for values in found.values())
    off_m = np.sqrt(found["squared_error"])
    assert len(off_m) > 1000 and np.median(off_m) < 0.02
    std_m = np.sqrt(found["variance predictive"])
    assert 0.4 < (off_m < std_m).mean() < 0.95 and (off_m < 2.0 * std_m).mean() > 0.75


@pytest.mark.slow
def test_without_a_true_surface_the_reference_is_fused_from_the_readings(
    run: FinishedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, renderer = open_source(quick_job().path, run.config.input), FieldRenderer(OPTIONS, "cpu")
    exact = surface_errors(run, source, renderer)
    monkeypatch.setattr(type(source), "true_surface", lambda _: None)
    fused = surface_errors(run, source, renderer)
    assert exact is not None and fused is not None and exact.exact and not fused.exact
    assert np.median(fused.distance_m) == pytest.approx(np.median(exact.distance_m), abs=0.01)


def test_without_a_true_path_there_is_no_surface_to_compare_with(
    run: FinishedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = open_source(quick_job().path, run.config.input)
    monkeypatch.setattr(type(source), "truth", lambda _: None)
    assert surface_errors(run, source, FieldRenderer(OPTIONS, "cpu")) is None


def test_the_temperature_of_a_surface_comes_from_surfaces_with_any_reference() -> None:
    runs = []
    for source, surface, scale in (("a", EXACT, 4.0), ("b", FUSED, 9.0)):
        arrays = next(iter(samples(scale, 0).values()))
        arrays |= {f"variance {p.name}": arrays["variance V"] for p in SURFACE_PREDICTORS}
        runs.append(Run(source, {Kind("surface", MESH, surface): arrays | {"alpha": np.ones(20_000, np.float32)}}))
    first, second = score_runs(runs)
    rows = first[Kind("surface", MESH, EXACT)][VISIBLE]["predictors"]
    assert rows["ridge"]["temperature"] == pytest.approx(9.0, rel=0.05)
    assert rows["predictive"]["temperature"] == 1.0
    assert second[Kind("surface", MESH, FUSED)][VISIBLE]["predictors"]["ridge"]["temperature"] == pytest.approx(
        4.0, rel=0.05
    )


@pytest.mark.parametrize("quantity, unit", [("color", "RMSE, 0 to 1"), ("depth", "RMSE, m")])
def test_sparsification_charts_compare_each_predictor_with_the_calibrated_one(quantity, unit) -> None:
    random = np.random.default_rng(0)
    wanted = [p for p in PREDICTORS if p.quantity == quantity]
    arrays = {f"variance {p.name}": random.uniform(0.1, 1.0, 400).astype(np.float32) for p in wanted}
    arrays["alpha"] = np.ones(400, np.float32)
    arrays["squared_error"] = arrays[f"variance {wanted[-1].name}"] * random.uniform(0.5, 1.5, 400).astype(np.float32)
    charts = sparsification_charts(Kind(quantity, "final", HELD_BACK), arrays)
    ours = {p.name for p in wanted if p.calibrated}
    for chart in charts:
        names = [curve.name for curve in chart.curves]
        assert ours | {"true error"} <= set(names) and len({curve.colour for curve in chart.curves}) == len(names)
        assert chart.y_label == unit and "final map, held-back views" in chart.title and "removed" in chart.x_label
        oracle = next(curve for curve in chart.curves if curve.name == "true error").points
        assert (np.diff(oracle[:, 1]) <= 1e-6).all(), "the true error removes the largest errors first"
    assert {curve.name for chart in charts for curve in chart.curves} == {p.name for p in wanted} | {"true error"}


def test_a_straight_path_is_aligned_by_its_rotations_too() -> None:
    """The positions of a straight path do not fix the rotation about it."""
    random = np.random.default_rng(0)
    wanted = se3.exp(np.array([1.0, -2.0, 0.5, 0.3, 0.8, -0.4]))
    true = np.stack([se3.exp(np.array([0.1 * i, 0.0, 0.0, 0.0, 0.02 * i, 0.0])) for i in range(20)])
    true[:, 1:3, 3] = 0.0
    noise = np.stack([se3.exp(twist) for twist in 0.002 * random.normal(size=(20, 6))])
    np.testing.assert_allclose(aligned_poses(true, wanted @ true @ noise), wanted, atol=0.003)
