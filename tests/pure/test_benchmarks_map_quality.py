"""benchmarks/map_quality.py: which runs it makes, and how it counts spikes, surface and figures."""

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmark_results import laid_out
from sigmasplat.data.field import GaussianField

map_quality = importlib.import_module("map_quality")


def field(scales: list[list[float]], z_m: float = 2.0) -> GaussianField:
    """Make a row of splats 1 m apart, with these standard deviations along their axes."""
    means = torch.tensor([[float(i), 0.0, z_m] for i in range(len(scales))])
    return GaussianField.from_values(means, torch.tensor(scales), torch.full((len(scales), 3), 0.5), opacities=0.9)


def test_a_spike_is_long_thin_and_large_in_the_nearest_keyframe() -> None:
    needle, disc, short = [0.1, 0.002, 0.002], [0.1, 0.1, 0.001], [0.01, 0.0001, 0.0001]
    near, far = np.eye(4), np.eye(4)
    far[2, 3] = -20.0
    splats = field([needle, disc, short, needle])
    assert map_quality.spike_share(splats, near[None], 300.0) == pytest.approx(0.5)
    assert map_quality.spike_share(splats, np.stack([near, far]), 300.0) == pytest.approx(0.5), (
        "the nearest one decides"
    )
    assert map_quality.spike_share(splats, far[None], 300.0) == 0.0
    assert map_quality.spike_share(GaussianField.empty(), near[None], 300.0) == 0.0


def test_the_surface_is_that_of_occupied_cells() -> None:
    assert map_quality.surface_area_m2(field([[0.01] * 3] * 3)) == pytest.approx(3 * 0.05**2)
    faint = field([[0.01] * 3])
    faint.params[:, 10] = -4.0
    assert map_quality.surface_area_m2(faint) == 0.0


def test_this_checkout_and_the_one_before_take_turns(tmp_path: Path) -> None:
    options = map_quality.Options(
        ("livingroom", "synthetic"), (0, 1), before="old/sigmasplat", limit=9, hold_out=8, settings=("a.b=1",)
    )
    jobs = map_quality.jobs_of(options)
    assert [(job.sequence, job.seed, job.code) for job in jobs[:4]] == [
        ("livingroom", 0, "now"), ("livingroom", 0, "before"), ("synthetic", 0, "now"), ("synthetic", 0, "before"),
    ]  # fmt: skip
    words = jobs[1].words(options, tmp_path)
    assert words[:2] == ["old/sigmasplat", "run"] and len(jobs) == 8
    for pair in (["--limit", "9"], ["--set", "a.b=1"], ["--set", "input.hold_every=8"], ["--seed", "0"]):
        assert any(words[i : i + 2] == pair for i in range(len(words)))
    keyframes_only = jobs[1].words(replace(options, hold_out=0), tmp_path)
    assert not any("hold_every" in word for word in keyframes_only)


def test_a_failed_run_is_reported_and_repeated(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    options = map_quality.Options(("synthetic",), (0,), settings=("no.setting=1",), runs=runs, out=tmp_path)
    assert map_quality.main(options) == 1
    assert not list(runs.rglob("figures.json"))


def test_figures_are_means_over_the_seeds_now_and_before() -> None:
    runs = [
        {"sequence": "kitchen", "seed": seed, "code": code, "psnr_db": psnr + seed, "ate_m": 0.02}
        for seed in (0, 1) for code, psnr in (("now", 26.0), ("before", 24.0))
    ]  # fmt: skip
    (section,) = laid_out("map_quality", {"runs": [*runs, {"sequence": "x", "problem": "stopped"}]}).values()
    rows = {row[0]: row[1:] for row in section.rows}
    assert section.columns == ["", "now", "before"]
    assert rows["PSNR, dB"] == ["26.50 ± 0.71", "24.50 ± 0.71"]
    assert rows["ATE, cm"] == ["2.000 ± 0.0", "2.000 ± 0.0"] and rows["SSIM"] == ["–", "–"]
