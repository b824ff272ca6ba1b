"""Presets: the constants of CG-SLAM's paper and code, row by row, copied from these and not from our sources."""

import dataclasses
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytest

from sigmasplat.config import Config
from sigmasplat.config.text import override
from sigmasplat.errors import ConfigError
from sigmasplat.presets import default_preset, families, list_presets, preset

DATASETS = ("replica", "tum", "scannet")
PAPER = [f"cgslam-{dataset}" for dataset in DATASETS]
LIGHT = [f"cgslam-light-{dataset}" for dataset in DATASETS]
LOOPS = [f"cgslam-loops-{dataset}" for dataset in DATASETS]


def value_of(config: Config, name: str) -> Any:
    section, _, field = name.partition(".")
    return getattr(getattr(config, section), field)


def differing(a: Config, b: Config) -> set[str]:
    """Return the names of the settings in which two presets differ."""
    ours, theirs = a.to_dict(), b.to_dict()
    return {
        f"{section}.{name}"
        for section, values in ours.items()
        if isinstance(values, dict)
        for name, value in values.items()
        if theirs[section][name] != value
    }


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
    "mapping.freeze_old_colors": False,
    "mapping.prune_opacity": 0.005,
    "primitives.uncertain_m2": 0.025,
    "primitives.owner": "dominant",
    "primitives.faded_opacity": 0.07,
    "primitives.least_opacity": 15 / 255,
    "primitives.split_gradient": 0.002,
    "primitives.clone": True,
    "primitives.most_radius_px": 0.0,
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
    "tracking.motion_model": True,
    "tracking.exposure": False,
    "submaps.distance_m": 0.0,
    "submaps.angle_deg": 0.0,
    "submaps.frames": 0,
    "submaps.uncertainty_m": 0.0,
    "loops.close": False,
    "final.iterations": 0,
}


@pytest.mark.parametrize("name", ROWS)
def test_each_dataset_has_the_papers_number(name: str) -> None:
    assert [value_of(preset(p), name) for p in PAPER] == pytest.approx(list(ROWS[name]), rel=1e-12)


@pytest.mark.parametrize("name", COMMON)
def test_values_common_to_all_data_sets_are_the_papers(name: str) -> None:
    for config in map(preset, PAPER):
        assert value_of(config, name) == COMMON[name]


def test_every_pixel_is_seeded_and_no_reading_is_removed() -> None:
    """Replica's frames have 816 000 pixels; 16 bits of PNG end at 10, 13.1 and 65.5 m."""
    largest = (65535 / 6553.5, 65535 / 5000, 65535 / 1000)
    for config, depth_m in zip(map(preset, PAPER), largest, strict=True):
        assert config.seeding.first_uniform > 1200 * 680
        assert config.input.max_depth_m >= depth_m


def test_a_faded_splat_is_still_drawn() -> None:
    for config in map(preset, list_presets()):
        if config.primitives.uncertain_m2:
            assert config.render.alpha_min < config.primitives.faded_opacity
            assert config.mapping.prune_opacity < config.primitives.least_opacity < config.primitives.faded_opacity


def test_light_differs_only_by_half_the_width() -> None:
    for name, light, width in zip(PAPER, LIGHT, (600, 320, 320), strict=True):
        assert differing(preset(name), preset(light)) == {"input.width"}
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


@pytest.mark.parametrize("scene", SCENES)
def test_released_holds_the_scenes_row(scene: str) -> None:
    config = preset(f"cgslam-released-{scene}")
    t, m, p = config.tracking, config.mapping, config.primitives
    steps, rotation, translation, color, depth, map_steps, every, window, m_color, m_depth, extent = SCENES[scene]
    assert (t.iterations, t.lr_rotation, t.lr_translation) == (steps, rotation, translation)
    assert t.weight_color / (1 - t.weight_color) == pytest.approx(color / depth)
    assert (m.iterations, m.every, m.window) == (map_steps, every, window)
    assert (m.weight_l1, m.weight_ssim, m.weight_depth) == pytest.approx((m_color - 0.1, 0.1, m_depth))
    first, last = MEANS.get(scene, (3e-4, 2.5e-4))
    assert (m.lr_means_first, m.lr_means) == pytest.approx((first * extent, last * extent), rel=1e-12)
    assert m.lr_log_scales == pytest.approx(SCALES.get(scene, 1e-4) * extent, rel=1e-12)
    assert (p.split_scale_m, p.most_scale_m) == pytest.approx((0.01 * extent, 0.1 * extent), rel=1e-12)


@pytest.mark.parametrize("scene", SCENES)
def test_released_has_the_methods_of_the_code(scene: str) -> None:
    config = preset(f"cgslam-released-{scene}")
    m, p, t = config.mapping, config.primitives, config.tracking
    assert (m.weight_alignment, m.weight_isotropy_ratio, m.weight_moment) == (0.25, 0.1, 0.15)
    assert (m.poses, m.poses_from, m.covisibility) == ("newest", "half", "descriptor")
    assert (m.lr_pose_rotation, m.lr_pose_translation) == (0.0015, 0.00215)
    assert (p.uncertain_m2, p.owner, p.clone, p.split_gradient) == (0.0, "median", False, 0.002)
    assert (t.first_iterations, t.first_lr_rotation) == (200, 0.003)
    assert not config.render.covariance_pose_gradient
    assert config.input == preset(base_of(scene)).input


def test_presets_and_rows_of_the_table_match() -> None:
    released = {name.removeprefix("cgslam-released-") for name in list_presets() if "-released-" in name}
    assert released == set(SCENES)


# ---- ours


@pytest.mark.parametrize("dataset", [*DATASETS, "fast"])
def test_loops_presets_differ_only_in_the_sections_of_loops(dataset: str) -> None:
    loops, alone = preset(f"cgslam-loops-{dataset}"), preset(f"cgslam-{dataset}")
    like, plain = preset(f"varsplat-{dataset}"), preset(f"loopsplat-{dataset}")
    sections = {name.partition(".")[0] for name in differing(loops, alone)}
    assert sections <= {"submaps", "loops", "registration", "final"}
    assert loops.submaps == like.submaps
    assert (loops.loops, loops.registration, loops.final) == (plain.loops, plain.registration, plain.final)
    assert loops.loops.close and not loops.loops.uncertainty and not alone.loops.close


def test_fast_is_one_map_without_variance() -> None:
    fast, like = preset("cgslam-fast"), preset("varsplat-fast")
    assert fast.submaps == Config().submaps and not fast.loops.close and fast.final.iterations == 0
    assert (fast.mapping.weight_nll_color, fast.mapping.weight_nll_depth) == (0.0, 0.0)
    assert fast.tracking.uncertainty and fast.tracking.align_depth_by == "U"
    assert (fast.input, fast.seeding, fast.render) == (like.input, like.seeding, like.render)
    weights = [name for name in ROWS if name.startswith("mapping.weight")]
    assert [value_of(fast, name) for name in weights] == [value_of(preset("cgslam-replica"), name) for name in weights]
    assert (fast.primitives.uncertain_m2, fast.primitives.split_gradient) == (0.025, 0.0)


def test_sigma_adds_to_fast_and_removes_nothing() -> None:
    sigma, fast = preset("sigma"), preset("varsplat-fast")
    added = differing(sigma, fast)
    assert added == {"mapping.iterations", "mapping.weight_moment", "primitives.uncertain_m2"}
    assert sigma.mapping.weight_nll_color == fast.mapping.weight_nll_color > 0
    assert sigma.tracking.uncertainty and sigma.loops.uncertainty and sigma.registration.uncertainty


# ---- all of them


@pytest.mark.parametrize("name", list_presets())
def test_a_preset_loads_unchanged_from_text(name: str, tmp_path: Path) -> None:
    config = preset(name)
    assert config.name == name
    config.save(tmp_path / "config.json")
    assert Config.load(tmp_path / "config.json") == config
    for section in dataclasses.fields(Config):
        values = getattr(config, section.name)
        if not dataclasses.is_dataclass(values):
            continue
        for field in dataclasses.fields(
            values
        ):  # each value has the type of its setting, is one of the choices, and is not negative
            text = f"{section.name}.{field.name}", str(getattr(values, field.name))
            assert override(config, dict([text])) == config
            assert type(getattr(values, field.name)) is type(getattr(getattr(Config(), section.name), field.name)), text


def test_each_preset_is_in_one_of_four_families() -> None:
    assert families()[0] == default_preset() and len(families()) == 4
    for name in list_presets():
        assert sum(fnmatchcase(name, family) for family in families()) == 1, name


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fast", "no preset 'fast'; known: cgslam-fast, cgslam-loops-fast, loopsplat-fast, varsplat-fast (and "),
        ("fr1-desk", "no preset 'fr1-desk'; known: cgslam-released-fr1-desk (and "),
        ("cgslam-loops", "no preset 'cgslam-loops'; known: cgslam-loops-fast, cgslam-loops-replica, "),
        ("varsplat-fst", "no preset 'varsplat-fst' (did you mean varsplat-fast?); known: cgslam-fast, "),
        ("quick", f"no preset 'quick'; known: {', '.join(list_presets())}"),
    ],
)
def test_an_unknown_preset_suggests_similar_ones(name: str, message: str) -> None:
    with pytest.raises(ConfigError) as problem:
        preset(name)
    assert str(problem.value).startswith(message)
    assert ("varsplat-tum" in str(problem.value)) == (name in ("varsplat-fst", "quick"))


NEW = [
    "input.crop_px",
    "seeding.push_back",
    "mapping.weight_isotropy_ratio",
    "mapping.weight_alignment",
    "mapping.weight_moment",
    "mapping.lr_means_first",
    "mapping.poses",
    "mapping.poses_from",
    "mapping.window",
    "mapping.frames_per_step",
    "tracking.parametrisation",
    "tracking.first_iterations",
    "tracking.outlier_factor_color",
    "tracking.average",
    "tracking.align_depth_by",
]


@pytest.mark.parametrize("system", ["varsplat", "loopsplat"])
@pytest.mark.parametrize("dataset", [*DATASETS, "fast"])
def test_the_other_systems_use_no_setting_of_this_one(system: str, dataset: str) -> None:
    """Every setting added for CG-SLAM has its default, off, so that runs of the other systems do not change."""
    config, default = preset(f"{system}-{dataset}"), Config()
    assert {name: value_of(config, name) for name in NEW} == {name: value_of(default, name) for name in NEW}
    assert dataclasses.replace(config.primitives, split_radius_px=0.0) == default.primitives, "ours, not CG-SLAM's"
    assert (default.primitives.uncertain_m2, default.primitives.split_gradient, default.mapping.window) == (0, 0, 0)
