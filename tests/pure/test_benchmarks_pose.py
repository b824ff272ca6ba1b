"""The benchmark of the pose's gradient: it starts, its arithmetic is right, its tables say what was measured."""

import importlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from benchmark_results import laid_out
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.data.frame import Frame
from sigmasplat.errors import ConfigError
from sigmasplat.render import render

accuracy, localise, pose_gradient, tables = map(
    importlib.import_module, ("accuracy", "localise", "pose_gradient", "tables")
)
CAMERA = Camera(32, 24, 28.0, 28.0, 15.5, 11.5)
SEARCH = localise.Search(off_m=0.05, off_deg=2.0, steps=60, weight_color=0.6)


def shiny_corner(n: int = 900) -> GaussianField:
    """Make two walls that meet, of many colours which change with the direction they are seen from."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1.6, 1.6, n), rng.uniform(-1.3, 1.3, n)
    means = np.stack([x, y, 2.0 + 0.5 * np.abs(x)], 1)
    colors = 0.5 + 0.3 * np.stack([np.sin(3 * x + k) * np.cos(4 * y - k) for k in range(3)], 1)
    values = [torch.as_tensor(v).float() for v in (means, np.full(n, 0.07), colors)]
    field = GaussianField.from_values(*values, opacities=0.95)
    k = torch.zeros(n, 45)
    k[:, :9] = torch.as_tensor(rng.normal(0, 0.3, (n, 9)))
    field.attributes["harmonics"] = Rows(k)
    return field


def test_frames_are_found_by_every_way() -> None:
    field, T_true = shiny_corner(), se3.exp(np.array([0.1, -0.05, 0.02, 0.03, 0.1, -0.02]))
    seen = render(field, CAMERA, T_true)
    frame = Frame(0, 0.0, seen.color.clamp(0, 1).numpy().copy(), seen.depth.numpy().copy(), CAMERA)
    start = localise.disturbed(T_true, SEARCH, np.random.default_rng(1))
    for switches in localise.WAYS.values():
        T, ms = localise.localise(field, frame, start, switches, SEARCH)
        error = T @ se3.inverse(T_true)
        assert np.linalg.norm(error[:3, 3]) < 0.2 * SEARCH.off_m and ms > 0
        assert np.degrees(se3.rotation_angle(error[:3, :3])) < 0.2 * SEARCH.off_deg
    found = localise.shares(field, frame, start, SEARCH)
    assert tuple(found) == ("covariance", "all others") and all(min(part) > 0 for part in found.values())
    assert localise.view_dependence(field, frame, T_true) > 0.01
    assert localise.view_dependence(GaussianField(field.params), frame, T_true) == 0


def test_a_start_is_so_far_off() -> None:
    random, T = np.random.default_rng(2), se3.exp(np.random.default_rng(3).normal(size=6))
    starts = [localise.disturbed(T, SEARCH, random) for _ in range(4)]
    for start in starts:
        assert np.linalg.norm((start - T)[:3, 3]) == pytest.approx(SEARCH.off_m)
        assert np.degrees(se3.rotation_angle(start[:3, :3] @ T[:3, :3].T)) == pytest.approx(SEARCH.off_deg)
    assert len({start.tobytes() for start in starts}) == 4


def test_the_covariance_has_a_small_share_in_a_plain_map_that_is_off_in_depth_alone() -> None:
    """Of one colour, without harmonics, seen from too far away."""
    params = shiny_corner().params
    params[:, 11:14] = 0.5
    field = GaussianField(params)
    seen = render(field, CAMERA, np.eye(4))
    frame = Frame(0, 0.0, seen.color.clamp(0, 1).numpy().copy(), seen.depth.numpy() - np.float32(0.1), CAMERA)
    found = localise.shares(field, frame, np.eye(4), replace(SEARCH, weight_color=0.0))
    assert 0.0 < found["covariance"][0] < 0.4 and 0.7 < found["all others"][0] < 1.3


def test_pixels_without_reading_or_map_have_no_part_in_the_loss() -> None:
    color, depth = torch.zeros(2, 2, 3), torch.tensor([[1.0, 0.0], [1.0, 1.0]])
    alpha = torch.tensor([[1.0, 1.0], [0.5, 1.0]])
    seen = SimpleNamespace(color=color + torch.tensor([0.1, 0.2, 0.3]), depth=torch.full((2, 2), 1.5), alpha=alpha)
    assert float(localise.pose_loss(seen, color, depth, 0.75)) == pytest.approx(0.75 * 0.2 + 0.25 * 0.5)
    assert float(localise.pose_loss(seen, color, 0 * depth, 0.75)) == 0


def test_held_out_frames_have_a_keyframe_before_them() -> None:
    kinds = "hkhhklhhh"  # h: held out, k: keyframe, l: lost
    slam: Any = SimpleNamespace(steps=[SimpleNamespace(is_keyframe=kind == "k", lost=kind == "l") for kind in kinds])
    assert pose_gradient.held_out(slam, 9) == [(2, 1), (3, 1), (6, 4), (7, 4), (8, 4)]
    assert pose_gradient.held_out(slam, 2) == [(2, 1), (8, 4)]
    slam.steps = slam.steps[:1]
    assert pose_gradient.held_out(slam, 2) == []


def test_time_by_iteration_is_the_median_frames() -> None:
    log = [{"seconds": {"track": t}, "tracking": {"iterations": n}} for t, n in ((0.1, 10), (0.9, 10), (0.04, 2))]
    first = {"seconds": {"track": 0.0}, "tracking": {}}
    assert pose_gradient.iteration_ms([first, *log]) == pytest.approx(20.0)
    assert pose_gradient.iteration_ms([first]) is None


def test_runs_differ_by_the_switch_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def ran(jobs: list[Any], options: Any) -> list[dict[str, Any]]:
        asked.extend(jobs)
        figures = {"ate_m": 0.02, "rpe_m": 0.001, "rpe_deg": 0.1, "lost": 0}
        return [{"problem": None if job.seed else "a | b", "wall_s": 1.0, "figures": figures} for job in jobs]

    log = [{"seconds": {"track": 0.3}, "tracking": {"iterations": 30}}]
    monkeypatch.setattr(accuracy, "run_all", ran)
    monkeypatch.setattr(
        pose_gradient.RunFolder,
        "open",
        lambda path: SimpleNamespace(read_log=lambda: log if path.name == "run" else []),
    )
    jobs = pose_gradient.measure_sequences(pose_gradient.Options(sources=("s", "t"), seeds=(0, 1), runs=tmp_path))
    configs = [job.key()["config"] for job in asked]
    switches = [config["render"].pop("covariance_pose_gradient") for config in configs]
    assert switches == [False] * 4 + [True] * 4 and configs[:4] == configs[4:]
    rates = [pose_gradient.Options(rates=name).tracking_settings("with covariance")[-3] for name in pose_gradient.RATES]
    assert rates == ["tracking.lr_rotation=0.002", "tracking.lr_rotation=0.0002", "tracking.lr_rotation=0.00075"]
    assert configs[0]["tracking"]["method"] == "adam" and configs[0]["tracking"]["iterations"] == 30
    rules = [value for name, value in configs[0]["submaps"].items() if name != "inherit"]
    assert configs[0]["final"]["iterations"] == 0 and not any(rules)
    made = laid_out("pose_gradient", {"sequence": jobs})
    rows = [[s, f"{way} covariance", "1", "2"] for s, way in (("s", "without"), ("s", "with"), ("t", "without"))]
    assert [row[:4] for row in made["Sequences"].rows[:3]] == rows
    assert made["Sequences"].rows[0][-1] == "10" and len(made["Failed"].rows) == 4


def test_a_map_gains_its_harmonics_in_time() -> None:
    options = pose_gradient.Options(degree=3, refinement=80)
    final = options.map_config(7).final
    assert (final.iterations, final.sh_degree, final.sh_every) == (80, 3, 8) and options.map_config(7).seed == 7
    with pytest.raises(ConfigError, match="1 to 3, found 0"):
        replace(options, degree=0).map_config(7)


def test_frames_are_found_and_held_against_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole of it, tiny: a start is as far off as it should be, and every frame has every way."""
    fast = ("mapping.iterations=2", "mapping.first_iterations=10")
    settings = pose_gradient.Options.map_settings
    monkeypatch.setattr(pose_gradient.Options, "map_settings", lambda options: (*settings(options), *fast))
    options = pose_gradient.Options(limit=8, width=48, refinement=9, frames=2, steps=3, off_m=0.5)
    found = pose_gradient.measure_localise("synthetic:frames=400,width=64,height=48", options, 3)
    ways = ["as tracked", "start", *localise.WAYS]
    assert [f["way"] for f in found["found"]] == 2 * ways and found["seed"] == 3
    for f in found["found"]:
        off_cm = {"as tracked": 0.0, "start": 50.0}.get(f["way"])
        assert off_cm is None or f["translation_cm"] == pytest.approx(off_cm, abs=3.0)
        assert (f["ms"] > 0) == (f["way"] in localise.WAYS)
    made = laid_out("pose_gradient", {"localise": [{"source": "room", "maps": [found]}]})
    assert [row[1] for row in made["Localisation"].rows] == ways
    assert [row[1] for row in made["Paths"].rows] == ["covariance", "all others"] and len(found["shares"]) == 2


def test_medians_and_how_many_are_nearer() -> None:
    errors = {"start": [2.0, 2.0, 2.0], "mean + depth": [0.3, 0.1, 0.2], "+ covariance": [0.2, 0.2, 0.1]}
    found = [
        {"frame": i, "way": way, "ms": 0.0 if way == "start" else 5.0, "translation_cm": e, "rotation_deg": e / 10}
        for way, all_errors in errors.items()
        for i, e in enumerate(all_errors)
    ]
    parts = [{"mean": [0.5, share], "depth": [0.9, 0.8]} for share in (0.1, 0.2, 0.4)]
    maps = [{"seed": 0, "splats": 9, "view_dependence": 0.01, "shares": parts, "found": found}]
    made = laid_out("pose_gradient", {"localise": [{"source": "room", "maps": maps}]})
    assert made["Paths"].rows == [["room", "mean", "50.0", "20.0"], ["room", "depth", "90.0", "80.0"]]
    section = made["Localisation"]
    assert section.rows == [
        ["room", "start", "3", "2.00", "–", "0.200", "–", "–"],
        ["room", "mean + depth", "3", "0.200", "–", "0.0200", "–", "5.00"],
        ["room", "+ covariance", "3", "0.200", "67", "0.0200", "67", "5.00"],
    ]
    assert "room 0.0100" in section.note


def test_the_quick_way_is_a_part_of_the_whole() -> None:
    whole = pose_gradient.Options()
    quick = pose_gradient.shortened(whole)
    assert (quick.sources, quick.seeds) == (whole.sources[:1], whole.seeds[:1]) and quick.limit < whole.limit
