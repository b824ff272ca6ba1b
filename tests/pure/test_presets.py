"""Presets: the constants of the papers and their code, row by row, written here from them and from no other file."""

import dataclasses
import itertools
import tomllib
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytest
import torch

from changed_settings import changed_settings
from sigmasplat.config import Config
from sigmasplat.config.find_preset import FAMILIES, default_preset, list_presets, preset, presets_by_scene
from sigmasplat.config.text import override
from sigmasplat.data.camera import Camera
from sigmasplat.errors import ConfigError
from sigmasplat.files.json_files import write_json
from sigmasplat.fit.losses import NLL_EPS, total
from sigmasplat.plugins.presets.shared_by_papers import BASE

SOURCES = Path(__file__).parents[2] / "docs" / "theme" / "sources.toml"
DATASETS = ("replica", "tum", "scannet")
EVERY = [*list_presets(), *presets_by_scene()]
PAPER = [f"cgslam-{dataset}" for dataset in DATASETS]
LIGHT = [f"cgslam-light-{dataset}" for dataset in DATASETS]
LOOPS = [f"cgslam-loops-{dataset}" for dataset in DATASETS]


def value_of(config: Config, name: str) -> Any:
    section, _, field = name.partition(".")
    return getattr(getattr(config, section), field)


# ---- values of the paper, or of its code if the paper gives none

ROWS: dict[str, tuple[Any, Any, Any]] = {  # replica, tum, scannet
    "mapping.weight_l1": (0.7, 1.0, 1.0),
    "mapping.weight_ssim": (0.1, 0.1, 0.1),
    "mapping.weight_depth": (0.25, 0.8, 0.8),
    "mapping.weight_alignment": (0.25, 0.5, 0.5),
    "mapping.weight_isotropy_ratio": (0.1, 0.1, 0.1),
    "mapping.weight_moment": (0.15, 0.5, 0.5),
    "mapping.every": (30, 15, 15),
    "mapping.iterations": (60, 50, 50),
    "mapping.lr_means_first": (3e-4 * 5, 3e-4 * 3, 3e-4 * 2),
    "mapping.lr_means": (2.5e-4 * 5, 2.5e-4 * 3, 2.5e-4 * 2),
    "mapping.lr_log_scales": (1e-4 * 5, 1e-4 * 3, 1e-4 * 2),
    "primitives.split_scale_m": (0.05, 0.03, 0.02),
    "primitives.most_scale_m": (0.5, 0.3, 0.2),
    "tracking.iterations": (15, 25, 25),
    "tracking.weight_color": (0.2 / 1.2, 1.0 / 1.6, 1.0 / 1.6),
    "input.width": (0, 0, 0),
    "input.crop_px": (0, 8, 10),
}
COMMON: dict[str, Any] = {
    "render.alpha_min": 15 / 255,
    "render.near_m": 0.2,
    "render.covariance_pose_gradient": True,
    "seeding.first_gradient": 0,
    "seeding.first_edges": False,
    "seeding.later_max": 0,
    "seeding.density": 1.0,
    "seeding.max_splats": 0,
    "seeding.alpha_below": 0.5,
    "seeding.depth_error_factor": 0.0,
    "seeding.opacity": 0.5,
    "seeding.scale_from": "neighbours",
    "seeding.push_back": 1.0,
    "seeding.min_distance_m": 0.0,
    "seeding.outlier_neighbours": 0,
    "mapping.overlap_below": 0.0,
    "mapping.first_iterations": 1500,
    "mapping.weight_isotropy": 0.0,
    "mapping.weight_nll_color": 0.0,
    "mapping.weight_nll_depth": 0.0,
    "mapping.lr_colors": 0.0025,
    "mapping.lr_opacity_logits": 0.05,
    "mapping.lr_quats": 0.001,
    "mapping.lr_pose_rotation": 0.0015,
    "mapping.lr_pose_translation": 0.00215,
    "mapping.poses": "all",
    "mapping.poses_from": "half",
    "mapping.window": 4,
    "mapping.covisibility": "splats",
    "mapping.frames_per_step": 0,
    "mapping.colors": "free",
    "mapping.prune_opacity": 0.005,
    "primitives.uncertain_m2": 0.025,
    "primitives.faded_opacity": 0.07,
    "primitives.least_opacity": 15 / 255,
    "primitives.split_gradient": 0.002,
    "primitives.clone": True,
    "tracking.method": "adam",
    "tracking.parametrisation": "axis-angle",
    "tracking.first_iterations": 0,
    "tracking.lr_rotation": 0.0015,
    "tracking.lr_translation": 0.00215,
    "tracking.uncertainty": False,
    "tracking.alpha_power": 0.0,
    "tracking.alpha_above": 0.99,
    "tracking.outlier_factor": 10.0,
    "tracking.outlier_factor_color": 10.0,
    "tracking.average": "kept",
    "tracking.exposure": False,
    "submaps.distance_m": 0.0,
    "submaps.angle_deg": 0.0,
    "submaps.frames": 0,
    "submaps.uncertainty_m": 0.0,
    "loops.close": False,
    "final.iterations": 0,
}


def test_each_dataset_has_the_papers_numbers() -> None:
    configs = [preset(name) for name in PAPER]
    found = {name: [value_of(config, name) for config in configs] for name in ROWS}
    assert found == {name: pytest.approx(list(row), rel=1e-12) for name, row in ROWS.items()}
    assert [{name: value_of(config, name) for name in COMMON} for config in configs] == [COMMON] * len(PAPER)


def test_every_pixel_is_seeded_and_no_reading_is_removed() -> None:
    """Replica's frames have 816 000 pixels; 16 bits of PNG end at 10, 13.1 and 65.5 m."""
    largest = (65535 / 6553.5, 65535 / 5000, 65535 / 1000)
    for config, depth_m in zip(map(preset, PAPER), largest, strict=True):
        assert config.seeding.first_uniform > 1200 * 680
        assert config.input.max_depth_m >= depth_m


def test_a_faded_splat_is_still_drawn() -> None:
    for config in map(preset, EVERY):
        if config.primitives.uncertain_m2:
            assert config.render.alpha_min < config.primitives.faded_opacity
            assert config.mapping.prune_opacity < config.primitives.least_opacity < config.primitives.faded_opacity


def test_light_differs_only_by_half_the_width() -> None:
    for name, light, width in zip(PAPER, LIGHT, (600, 320, 320), strict=True):
        assert changed_settings(preset(name), preset(light)) == {"input.width"}
        assert preset(light).input.width == width


# ---- the table of the code
# scene: track it, rot lr, trans lr, λ1, λ2, map it, interval, k, M_color, M_depth, lr_scale

TABLE = """
replica    15 .0015  .00215 .2 1.0  60 30 4  .8  .25 5
fr1-desk   50 .0015  .00215 1  .5   50 15 3  1.0 .8  2
fr1-desk2  50 .0015  .00215 1  .6   80 10 8  .9  1.0 2
fr1-room   50 .0015  .00215 1  .6   80 10 6  .9  1.0 3
fr2-xyz    50 .0015  .00215 1  .6   50 15 8  1.0 .7  5
fr3-office 50 .0015  .00215 1  .6   30 15 8  1.0 .8  5
scene0000  50 .00075 .00115 1  .5   50 15 10 1.0 .7  2
scene0059  50 .0025  .00215 1  .5   50 5  10 1.0 .8  2
scene0106  50 .0025  .00215 .8 1.0  50 5  3  1.0 1.0 2
scene0169  50 .0025  .00215 1  .5   50 15 8  1.0 .7  3
scene0181  50 .0025  .00215 1  .8   50 5  10 1.0 1.0 2
scene0207  50 .0025  .00215 1  .8   50 15 10 1.0 .7  2
"""
SCENES = {row.split()[0]: [float(number) for number in row.split()[1:]] for row in TABLE.strip().splitlines()}
MEANS = {"fr1-room": (1.6e-4, 4e-5)}
SCALES = {"fr3-office": 1e-3}


def base_of(scene: str) -> str:
    return "cgslam-" + {"r": "replica", "f": "tum", "s": "scannet"}[scene[0]]


def test_each_released_preset_holds_the_row_of_its_scene() -> None:
    for scene, row in SCENES.items():
        config = preset(f"cgslam-released-{scene}")
        t, m, p = config.tracking, config.mapping, config.primitives
        steps, rotation, translation, color, depth, map_steps, every, window, m_color, m_depth, extent = row
        first, last = MEANS.get(scene, (3e-4, 2.5e-4))
        expected: dict[str, tuple[object, object]] = {
            "tracking": ((t.iterations, t.lr_rotation, t.lr_translation), (steps, rotation, translation)),
            "color": (t.weight_color / (1 - t.weight_color), pytest.approx(color / depth)),
            "mapping": ((m.iterations, m.every, m.window), (map_steps, every, window)),
            "weights": ((m.weight_l1, m.weight_ssim, m.weight_depth), pytest.approx((m_color - 0.1, 0.1, m_depth))),
            "means": ((m.lr_means_first, m.lr_means), pytest.approx((first * extent, last * extent), rel=1e-12)),
            "log scales": (m.lr_log_scales, pytest.approx(SCALES.get(scene, 1e-4) * extent, rel=1e-12)),
            "scales": ((p.split_scale_m, p.most_scale_m), pytest.approx((0.01 * extent, 0.1 * extent), rel=1e-12)),
        }
        assert {name: values for name, values in expected.items() if values[0] != values[1]} == {}, scene


def test_released_presets_share_the_settings_of_the_code() -> None:
    for scene in SCENES:
        config = preset(f"cgslam-released-{scene}")
        m, p, t = config.mapping, config.primitives, config.tracking
        assert (m.weight_alignment, m.weight_isotropy_ratio, m.weight_moment) == (0.25, 0.1, 0.15), scene
        assert (m.poses, m.poses_from, m.covisibility) == ("newest", "half", "descriptor"), scene
        assert (m.lr_pose_rotation, m.lr_pose_translation) == (0.0015, 0.00215), scene
        assert (p.uncertain_m2, p.clone, p.split_gradient) == (0.0, False, 0.002), scene
        assert (t.first_iterations, t.first_lr_rotation) == (200, 0.003), scene
        assert not config.render.covariance_pose_gradient, scene
        assert config.loops.descriptor == "netvlad-or-grid" and not config.loops.close, scene
        assert config.input == preset(base_of(scene)).input, scene


def test_presets_and_rows_of_the_table_match() -> None:
    released = [name.partition("-released-") for name in presets_by_scene()]
    assert {scene for system, _, scene in released if system == "cgslam"} == set(SCENES)
    assert {scene for system, _, scene in released if system == "varsplat"} == set(VARSPLAT_SCENES)


# ---- VarSplat's code
# scene: data set, tau of tracking, tau of loops, NLL of depth, crop px

VARSPLAT_TABLE = """
room0      replica   10  10 1 0
room1      replica   100 30 1 0
room2      replica   10  10 1 0
office0    replica   100 30 1 0
office1    replica   10  5  1 0
office2    replica   10  5  1 0
office3    replica   10  5  1 0
office4    replica   100 30 1 0
fr1-desk   tum       50  10 0 50
fr1-desk2  tum       50  10 1 50
fr1-room   tum       100 30 0 50
fr2-xyz    tum       50  10 0 8
fr3-office tum       50  10 0 50
scene0000  scannet   10  5  0 12
scene0054  scannet   30  10 0 12
scene0059  scannet   5   3  1 12
scene0106  scannet   5   3  0 12
scene0169  scannet   5   3  0 12
scene0181  scannet   20  5  0 12
scene0207  scannet   30  10 0 12
scene0233  scannet   30  10 0 12
scene0465  scannet   30  10 1 12
281bc17764 scannetpp 20  5  1 0
2e74812d00 scannetpp .5  5  1 0
8b5caf3398 scannetpp 3   5  1 0
b20a261fdf scannetpp 3   5  1 0
fb05e13ad1 scannetpp 30  5  0 0
"""
VARSPLAT_SCENES = {row.split()[0]: row.split()[1:] for row in VARSPLAT_TABLE.strip().splitlines()}
PER_DATASET: dict[str, dict[str, Any]] = {  # loops.min_interval: the code asks for more than its number
    "replica": {
        "loops.min_interval": 2 + 1, "registration.method": "code-fine", "tracking.restart": "longer",
        "tracking.outlier_factor": 50.0, "tracking.alpha_above": 0.0, "tracking.alpha_power": 3.0, "input.limit": 0,
    },
    "tum": {
        "loops.min_interval": 3 + 1, "registration.method": "code", "tracking.restart": "longer",
        "tracking.outlier_factor": 0.0, "tracking.alpha_above": 0.0, "tracking.alpha_power": 3.0, "input.limit": 0,
    },
    "scannet": {
        "loops.min_interval": 4 + 1, "registration.method": "rendered", "tracking.restart": "longer",
        "tracking.outlier_factor": 50.0, "tracking.alpha_above": 0.98, "tracking.alpha_power": 3.0, "input.limit": 0,
    },
    "scannetpp": {
        "loops.min_interval": 2, "registration.method": "code", "tracking.restart": "odometry",
        "tracking.outlier_factor": 50.0, "tracking.alpha_above": 0.98, "tracking.alpha_power": 0.0, "input.limit": 250,
    },
}  # fmt: skip
METHODS = {
    "seeding.alpha_below": 0.6, "seeding.shape": "neighbours-behind", "mapping.colors": "code",
    "tracking.descent": "amsgrad", "registration.tau": 3.0, "final.schedule": "falling",
}  # fmt: skip


def test_each_released_varsplat_preset_holds_the_row_of_its_scene() -> None:
    for scene, (dataset, *numbers) in VARSPLAT_SCENES.items():
        config = preset(f"varsplat-released-{scene}")
        tau, tau_loops, nll_depth, crop = map(float, numbers)
        assert (config.tracking.tau, config.loops.tau) == (tau, tau_loops), scene
        assert (config.mapping.weight_nll_depth, config.input.crop_px) == (nll_depth * 1e-4, crop), scene
        assert config.tracking.exposure == (dataset == "scannet"), scene
        expected = PER_DATASET[dataset] | METHODS
        assert {name: value_of(config, name) for name in expected} == expected, scene


def test_released_varsplat_presets_differ_from_the_papers_by_the_methods_of_the_code_alone() -> None:
    rows = {"tracking.tau", "loops.tau", "loops.min_similarity", "mapping.weight_nll_depth", "input.crop_px"}
    for scene, (dataset, *_) in VARSPLAT_SCENES.items():
        released, paper = preset(f"varsplat-released-{scene}"), preset(f"varsplat-{dataset}")
        changed = changed_settings(released, paper) - rows - {"seeding.outliers"}
        assert set(METHODS) <= changed <= set(METHODS) | set(PER_DATASET[dataset]), scene
        assert released.tracking.amsgrad and not paper.tracking.amsgrad and released.final.lr_means_last == 1.6e-6
        before = paper.seeding.outlier_neighbours
        assert released.seeding.outlier_neighbours == before and released.seeding.outlier_first == (before == 0), scene
        assert (released.seeding.push_back, paper.seeding.push_back) == (1.005, 1.0), scene


# ---- the text of VarSplat with its supplement, row by row

TEXT: dict[str, tuple[Any, Any, Any, Any]] = {  # replica, tum, scannet, scannetpp
    "tracking.tau": (10.0, 50.0, 5.0, 10.0),
    "registration.tau": (10.0, 50.0, 5.0, 10.0),
    "tracking.weight_color": (0.95, 0.6, 0.6, 0.5),
    "tracking.lr_rotation": (2e-4, 2e-3, 2e-3, 2e-3),
    "tracking.lr_translation": (2e-3, 1e-2, 1e-2, 1e-2),
    "tracking.iterations": (60, 200, 200, 300),
    "mapping.iterations": (100, 100, 100, 500),
    "mapping.first_iterations": (1000, 100, 100, 500),
    "mapping.every": (5, 1, 1, 2),
    "mapping.prune_opacity": (0.1, 0.5, 0.5, 0.5),
    "seeding.first_uniform": (600_000, 100_000, 100_000, 400_000),
    "seeding.later_max": (0, 30_000, 30_000, 100_000),
    "submaps.distance_m": (0.5, 0.5, 0.0, 0.0),
    "submaps.angle_deg": (50.0, 50.0, 0.0, 0.0),
    "submaps.frames": (0, 0, 50, 100),
    "loops.min_similarity": (0.5, 0.5, 0.5, 0.33),
    "tracking.restart": ("off", "off", "off", "odometry"),
    "tracking.exposure": (False, False, True, False),
    "input.limit": (0, 0, 0, 250),
    "input.width": (0, 0, 0, 876),
    # from the code, where the text gives none
    "input.crop_px": (0, 16, 12, 0),
    "loops.min_interval": (2, 3, 4, 2),
    "registration.lr_translation": (1e-3, 5e-3, 5e-3, 5e-3),
    "registration.lr_rotation": (3e-3, 1.5e-2, 1.5e-2, 1.5e-2),
    "seeding.min_distance_m": (1e-7**0.5, 1e-2, 1e-2, 1e-4),
    "seeding.outlier_neighbours": (0, 40, 40, 0),
}
SHARED_TEXT: dict[str, Any] = {
    "mapping.weight_nll_color": 1e-4, "mapping.weight_nll_depth": 1e-4, "mapping.weight_l1": 0.8,
    "mapping.weight_ssim": 0.2, "mapping.weight_depth": 1.0, "mapping.weight_isotropy": 1.0,
    "mapping.newest_probability": 0.4, "mapping.colors": "free",
    "seeding.alpha_below": 0.98, "seeding.depth_error_factor": 40.0, "seeding.opacity": 0.5, "seeding.push_back": 1.0,
    "seeding.first_edges": True, "seeding.first_gradient": 50_000,
    "tracking.alpha_power": 3.0, "tracking.alpha_above": 0.0, "tracking.outlier_factor": 50.0,
    "tracking.weight_max": 3.0, "loops.tau": 10.0, "loops.descriptor": "netvlad-or-grid",
    "registration.keyframes": 2, "registration.weight_color": 0.5, "registration.plain_gate": True,
    "registration.textured": False, "registration.overlap_least": 0.2, "registration.iterations": 100,
    "render.near_m": 0.2, "final.seed_from": "mesh", "final.iterations": 30_000, "final.sh_degree": 3,
    "final.spacing_m": 0.02, "final.sh_every": 1000, "final.prune_every": 500, "final.prune_opacity": 0.005,
    "final.uncertainty": False,
}  # fmt: skip


def test_varsplats_presets_hold_the_texts_numbers() -> None:
    configs = [preset(f"varsplat-{name}") for name in (*DATASETS, "scannetpp")]
    found = {name: [value_of(config, name) for config in configs] for name in TEXT}
    expected = {n: list(row) if isinstance(row[0], str) else pytest.approx(list(row)) for n, row in TEXT.items()}
    assert found == expected
    for config in configs:
        assert {name: value_of(config, name) for name in SHARED_TEXT} == SHARED_TEXT, config.name


def test_the_likelihood_of_the_text_is_that_of_both_residuals_with_one_whole_logarithm() -> None:
    """Eq. 13, 14: (r_c² + r_d²) / 2V + log V, on every data set; λ_var is 1e-4."""
    random = torch.Generator().manual_seed(3)
    color, seen, V = (torch.rand(6, 7, 3, generator=random, dtype=torch.float64) for _ in range(3))
    depth, read = (1.0 + torch.rand(6, 7, generator=random, dtype=torch.float64) for _ in range(2))
    V, valid = 0.01 + V, torch.ones(6, 7, dtype=torch.bool)
    for dataset in (*DATASETS, "scannetpp"):
        m = preset(f"varsplat-{dataset}").mapping
        weights = {"nll_color": m.weight_nll_color, "nll_depth": m.weight_nll_depth}
        maps = {"color": color, "color_target": seen, "depth": depth, "depth_target": read, "variance": V}
        squares = (color - seen) ** 2 + ((depth - read) ** 2)[..., None]
        text = (squares / (2 * (V + NLL_EPS)) + (V + NLL_EPS).log()).mean()
        assert float(total(weights, maps | {"valid": valid})) == pytest.approx(1e-4 * float(text), rel=1e-12), dataset


def test_scannetpp_is_read_at_half_of_its_size() -> None:
    camera = Camera(1752, 1168, 625.4, 627.0, 876.0, 584.0)
    for name in ("varsplat-scannetpp", "loopsplat-scannetpp", "varsplat-released-b20a261fdf"):
        working = camera.prepared(preset(name).input.width, preset(name).input.crop_px)
        assert (working.width, working.height) == (876, 584), name


# ---- what is ours is off in the papers' presets

OF_PAPERS = [name for name in EVERY if name != "sigma" and not name.endswith("-fast")]


def test_nothing_of_ours_is_on_in_a_preset_of_a_paper() -> None:
    ours = tomllib.loads(SOURCES.read_text(encoding="utf-8"))["ours"]
    assert {"submaps.uncertainty_m", "tracking.lost_share", "recovery.relocalise", "registration.judges"} <= set(ours)
    on = {(n, name, v) for n in OF_PAPERS for name in ours if (v := value_of(preset(n), name)) != ours[name]}
    assert on == set() and len(OF_PAPERS) > 40
    assert all(value_of(preset("sigma"), name) != off for name, off in ours.items()), "a rule that sigma has off"


# ---- ours


def test_the_baseline_differs_by_uncertainty_alone() -> None:
    switches = {"tracking.uncertainty", "loops.uncertainty", "registration.uncertainty"}
    optional = {"mapping.weight_nll_depth", "final.uncertainty"}
    always = {*switches, "mapping.weight_nll_color"}
    for dataset in (*DATASETS, "scannetpp", "fast"):
        ours, baseline = preset(f"varsplat-{dataset}"), preset(f"loopsplat-{dataset}")
        optional |= {"submaps.uncertainty_m"} if dataset == "fast" else set()
        assert always <= changed_settings(ours, baseline) <= always | optional, dataset
        assert not any(value_of(baseline, name) for name in (*switches, "final.uncertainty")), dataset
        assert baseline.mapping.weight_nll_color == baseline.mapping.weight_nll_depth == 0.0, dataset


def test_loops_are_those_of_the_other_system_and_the_rest_stays() -> None:
    for dataset in (*DATASETS, "fast"):
        loops, alone = preset(f"cgslam-loops-{dataset}"), preset(f"cgslam-{dataset}")
        like, plain = preset(f"varsplat-{dataset}"), preset(f"loopsplat-{dataset}")
        sections = {name.partition(".")[0] for name in changed_settings(loops, alone)}
        assert sections <= {"submaps", "loops", "registration", "final"}, dataset
        assert loops.submaps == like.submaps, dataset
        assert (loops.loops, loops.registration, loops.final) == (plain.loops, plain.registration, plain.final), dataset
        assert loops.loops.close and not loops.loops.uncertainty and not alone.loops.close, dataset


def test_fast_is_one_map_without_variance() -> None:
    fast, like = preset("cgslam-fast"), preset("varsplat-fast")
    assert fast.submaps == BASE.submaps and not fast.loops.close and fast.final.iterations == 0
    assert (fast.mapping.weight_nll_color, fast.mapping.weight_nll_depth) == (0.0, 0.0)
    assert fast.tracking.uncertainty and fast.tracking.align_depth_by == "U"
    assert (fast.input, fast.seeding, fast.render) == (like.input, like.seeding, like.render)
    weights = [name for name in ROWS if name.startswith("mapping.weight")]
    assert [value_of(fast, name) for name in weights] == [value_of(preset("cgslam-replica"), name) for name in weights]
    assert (fast.primitives.uncertain_m2, fast.primitives.split_gradient) == (0.025, 0.0)


def test_sigma_adds_to_fast_and_leaves_out_the_weights_of_tracking() -> None:
    sigma, fast = preset("sigma"), preset("varsplat-fast")
    added = changed_settings(sigma, fast)
    uncertainty = {"mapping.iterations", "tracking.uncertainty", "primitives.uncertain_m2", "uncertainty.probes"}
    assert added == uncertainty | {
        "mapping.overlap_below", "input.denoise_depth", "tracking.features", "tracking.verify",
        "final.iterations", "final.width", "final.schedule", "mapping.lr_log_scales", "seeding.shape",
        "mapping.divided", "mapping.first_iterations", "mapping.lr_pose_translation",
        "mapping.lr_pose_rotation",
        "registration.method", "registration.iterations",
        "final.move_poses", "recovery.relocalise", "surface.depth", "moving.find",
        "mapping.weight_depth", "mapping.weight_mean_depth", "render.depth",
        "final.sh_degree",
    }  # fmt: skip
    assert sigma.mapping.weight_nll_color == fast.mapping.weight_nll_color > 0
    assert not sigma.tracking.uncertainty and sigma.loops.uncertainty and sigma.registration.uncertainty


# ---- all of them


def test_saved_presets_come_back(tmp_path: Path) -> None:
    for name in EVERY:
        config = preset(name)
        assert config.name == name
        write_json(tmp_path / "config.json", config.to_dict())
        assert Config.load(tmp_path / "config.json") == config


def test_the_values_of_presets_are_allowed() -> None:
    """Each value has the type of its setting, is one of its words, and is not negative: an override accepts it."""
    default, wrong = Config(), list[str]()
    for config in map(preset, EVERY):
        for section in (
            f.name for f in dataclasses.fields(Config) if dataclasses.is_dataclass(getattr(config, f.name))
        ):
            for name, value in vars(getattr(config, section)).items():
                setting = f"{section}.{name}"
                of_the_type = type(value) is type(getattr(getattr(default, section), name))
                if not of_the_type or override(config, {setting: str(value)}) != config:
                    wrong.append(f"{config.name}: {setting}={value}")
    assert wrong == []


def test_families_are_few_and_leave_no_preset_out() -> None:
    assert FAMILIES[0] == default_preset() in list_presets() and len(FAMILIES) == 4
    for name in EVERY:
        assert sum(fnmatchcase(name, family) for family in FAMILIES) == 1, name
    for family in FAMILIES:
        assert any(fnmatchcase(name, family) for name in list_presets()), family


def test_the_default_settings_are_those_of_the_default_preset() -> None:
    assert dataclasses.replace(Config(), name="sigma") == preset("sigma") == preset(default_preset())


def test_a_scene_is_looked_up_in_the_table_of_its_code() -> None:
    assert preset("varsplat-released:room0") == preset("varsplat-released-room0")
    assert preset("varsplat-released:room0").name == "varsplat-released-room0"
    for name, message in (
        ("varsplat-released", "no scene in preset varsplat-released-SCENE; known: room0, room1, "),
        ("varsplat-released:rom0", "no scene 'rom0' (did you mean room"),
        (
            "cgslam-released-room0",
            "no scene 'room0' (did you mean fr1-room?) in preset cgslam-released-SCENE; known: replica, ",
        ),
    ):
        with pytest.raises(ConfigError) as problem:
            preset(name)
        assert str(problem.value).startswith(message) and "\n" not in str(problem.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fast", "no preset 'fast'; known: cgslam-fast, cgslam-loops-fast, loopsplat-fast, varsplat-fast (and "),
        ("fr1-desk", "no preset 'fr1-desk'; known: cgslam-released-fr1-desk, varsplat-released-fr1-desk (and "),
        ("cgslam-loops", "no preset 'cgslam-loops'; known: cgslam-loops-fast, cgslam-loops-replica, "),
        ("varsplat-fst", "no preset 'varsplat-fst' (did you mean varsplat-fast?); known: cgslam-fast, "),
        ("quick", f"no preset 'quick'; known: {', '.join(list_presets())}, cgslam-released-SCENE, "),
    ],
)
def test_an_unknown_preset_suggests_similar_ones(name: str, message: str) -> None:
    with pytest.raises(ConfigError) as problem:
        preset(name)
    assert str(problem.value).startswith(message)
    assert ("varsplat-tum" in str(problem.value)) == (name in ("varsplat-fst", "quick"))


NEW = [
    "mapping.weight_isotropy_ratio",
    "mapping.weight_alignment",
    "mapping.weight_moment",
    "mapping.lr_means_first",
    "mapping.adjustment",
    "mapping.window",
    "tracking.descent",
    "tracking.align_depth_by",
]


def test_the_earlier_systems_use_nothing_of_this_one() -> None:
    """Their runs stay what they were: every setting that came with CG-SLAM is off."""
    default = BASE
    for system, dataset in itertools.product(("varsplat", "loopsplat"), (*DATASETS, "fast")):
        config = preset(f"{system}-{dataset}")
        assert changed_settings(config, default).isdisjoint(NEW), config.name
        primitives = dataclasses.replace(config.primitives, split_radius_px=default.primitives.split_radius_px)
        assert primitives == default.primitives, f"{config.name}: split_radius_px is ours, the others are CG-SLAM's"
    assert (default.primitives.uncertain_m2, default.primitives.split_gradient, default.mapping.window) == (0, 0, 0)
