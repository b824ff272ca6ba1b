"""The experiments on what a variance is good for: an oracle finds the true pose, and tables count by clusters."""

import importlib
from typing import Any

import numpy as np
import pytest
import torch

from benchmark_results import laid_out

maps, poses = map(importlib.import_module, ("what_variance_maps", "what_variance_poses"))
WINDOW = maps.Window(maps.MIRRORS, 1, maps.map_config(64, 1, 8), 16)


@pytest.fixture(scope="module")
def field() -> Any:
    return WINDOW.fitted("none")


def test_the_oracle_of_each_pixel_finds_the_true_pose_by_colour_alone(field: Any) -> None:
    sigmas = dict.fromkeys(("text", "closed form"), torch.full((len(field), 3), -7.0))
    found = poses.measure_poses(WINDOW, field, sigmas, {poses.COLOR: 1.0})[poses.COLOR]
    assert set(found) == set(poses.WEIGHTS) and all(len(errors["mm"]) == 2 for errors in found.values())
    assert np.mean(found[poses.EACH_PIXEL]["mm"]) < 0.3 * np.mean(found[poses.NONE]["mm"]) < 15.0


def test_a_refit_of_variance_alone_is_as_large_as_the_error_and_code_is_mostly_scatter(field: Any) -> None:
    scored = maps.measure_sigma(WINDOW, field, maps.sigmas_of(WINDOW, field, 60))
    assert scored["σ² alone"]["share"] > 0.95 and 0.2 < scored["σ² alone"]["ratio"] < 3.0
    assert scored["Var(E), no σ²"]["share"] < 1e-6 < scored["code"]["share"] < 0.5
    assert scored["σ² alone"]["nll"] < scored["constant"]["nll"], "it was fitted by likelihood"


def test_mirrors_change_colours_with_the_view_and_no_depth() -> None:
    plain, mirrors = (maps.opened(name, 1, WINDOW.config).frame(3) for name in (maps.ROOM, maps.MIRRORS))
    assert np.abs(plain.color - mirrors.color).mean() > 0.02
    assert np.array_equal(plain.depth_m, mirrors.depth_m)


def test_changes_are_relative_and_clustered_by_source() -> None:
    def window(source: str, seed: int, mm: float) -> dict[str, Any]:
        of = {w: {"mm": [2.0 if w == poses.NONE else mm], "mdeg": [0.0]} for w in poses.WEIGHTS}
        sigma = {"code": dict.fromkeys(maps_scores(), 0.5)}
        return {"source": source, "seed": seed, "sigma": sigma, "poses": dict.fromkeys(poses.CONDITIONS, of)}

    windows = [window("a", 0, 1.0), window("a", 1, 1.0), window("b", 0, 3.0), window(maps.MIRRORS, 0, 1.0)]
    made = laid_out("what_variance_is_good_for", {"windows": windows})
    by_name = {row[0]: row[1] for row in made["Recordings and room"].rows}
    assert by_name["none: error, mm"] == "2.00" and by_name["V, τ 1"] == "+0±635"
    assert {row[0]: row[1] for row in made["Room with mirrors"].rows}["V, τ 1"] == "-50"
    assert made["Ways to learn σ²"].rows[0][1].startswith("50.00")


def maps_scores() -> list[str]:
    return list(importlib.import_module("what_variance_is_good_for_tables").SCORES)
