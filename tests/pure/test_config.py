"""Settings: values of presets, values that --set and the environment accept, and saving to config.json."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sigmasplat import env
from sigmasplat.config import Config
from sigmasplat.config.text import override, split_settings
from sigmasplat.errors import ConfigError
from sigmasplat.presets import default_preset, list_presets, preset


def test_presets_hold_the_papers_numbers() -> None:
    replica, tum, scannet = (preset(f"varsplat-{name}") for name in ("replica", "tum", "scannet"))
    assert [c.tracking.iterations for c in (replica, tum, scannet)] == [60, 200, 200]
    assert [c.tracking.weight_color for c in (replica, tum, scannet)] == [0.95, 0.6, 0.6]
    assert [c.tracking.lr_rotation for c in (replica, tum, scannet)] == [2e-4, 2e-3, 2e-3]
    assert [c.tracking.lr_translation for c in (replica, tum, scannet)] == [2e-3, 1e-2, 1e-2]
    assert [c.tracking.exposure for c in (replica, tum, scannet)] == [False, False, True]
    assert (replica.tracking.tau, tum.tracking.tau) == (10.0, 50.0)
    assert [c.mapping.first_iterations for c in (replica, tum)] == [1000, 100]
    assert [c.mapping.every for c in (replica, tum, scannet)] == [5, 1, 1]
    assert [c.mapping.prune_opacity for c in (replica, tum, scannet)] == [0.1, 0.5, 0.5]
    assert [c.mapping.weight_nll_depth for c in (replica, tum, scannet)] == [1e-4, 0.0, 0.0]
    assert [c.seeding.first_uniform for c in (replica, tum, scannet)] == [600_000, 100_000, 100_000]
    assert [c.seeding.later_max for c in (replica, tum, scannet)] == [0, 30_000, 30_000]
    assert replica.seeding.min_distance_m**2 == pytest.approx(1e-7)
    assert tum.seeding.min_distance_m**2 == pytest.approx(1e-4)
    for config in (replica, tum, scannet):
        assert config.tracking.method == "adam"
        assert config.tracking.weight_max == 3.0
        assert config.tracking.alpha_power == 3.0
        assert config.mapping.weight_nll_color == 1e-4
        assert (config.mapping.weight_l1, config.mapping.weight_ssim) == (0.8, 0.2)
        assert config.mapping.newest_probability == 0.4
        assert (config.loops.min_similarity, config.loops.tau, config.loops.near_m) == (0.5, 10.0, 0.0)
        assert (config.registration.keyframes, config.registration.iterations) == (2, 100)
        assert (config.registration.weight_color, config.registration.overlap_least) == (0.95, 0.2)
        assert config.registration.lr_rotation == pytest.approx(3 * config.registration.lr_translation)
        assert (config.final.seed_from, config.final.iterations, config.final.sh_degree) == ("mesh", 30_000, 3)
        assert (config.final.spacing_m, config.final.sh_every, config.final.prune_every) == (0.02, 1000, 500)
        assert config.final.prune_opacity == 0.005
        assert not config.final.uncertainty
    assert [(c.submaps.distance_m, c.submaps.angle_deg) for c in (replica, tum)] == [(0.5, 50.0)] * 2
    assert scannet.submaps.frames == 50
    assert [c.registration.lr_translation for c in (replica, tum, scannet)] == [1e-3, 5e-3, 5e-3]
    assert [c.registration.tau for c in (replica, tum)] == [10.0, 50.0]


@pytest.mark.parametrize("dataset", ["replica", "tum", "scannet", "fast"])
def test_the_baseline_differs_by_uncertainty_alone(dataset: str) -> None:
    ours, baseline = preset(f"varsplat-{dataset}").to_dict(), preset(f"loopsplat-{dataset}").to_dict()
    differing = {
        f"{section}.{name}"
        for section, values in ours.items()
        if isinstance(values, dict)
        for name, value in values.items()
        if baseline[section][name] != value
    }
    switches = {"tracking.uncertainty", "loops.uncertainty", "registration.uncertainty"}
    optional = {"mapping.weight_nll_depth", "final.uncertainty"}
    always = {*switches, "mapping.weight_nll_color", "submaps.uncertainty_m"}
    assert always <= differing <= always | optional
    assert not any(baseline[name.partition(".")[0]]["uncertainty"] for name in (*switches, "final.uncertainty"))
    assert baseline["mapping"]["weight_nll_color"] == baseline["mapping"]["weight_nll_depth"] == 0.0


def test_every_preset_has_its_name() -> None:
    assert {preset(name).name for name in list_presets()} == set(list_presets())
    assert default_preset() in list_presets()


def test_an_unknown_preset_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"did you mean varsplat-tum\?.*loopsplat-replica"):
        preset("varsplat-tun")


def test_override_converts_to_each_type() -> None:
    text = {
        "tracking.iterations": "60",
        "tracking.tau": "1e1",
        "tracking.uncertainty": "off",
        "tracking.method": "adam",
        "seed": " 7 ",
        "backend": "reference",
    }
    config = override(preset("varsplat-fast"), text)
    tracking = config.tracking
    assert (tracking.iterations, tracking.tau, tracking.uncertainty, tracking.method) == (60, 10.0, False, "adam")
    assert type(tracking.iterations) is int
    assert type(tracking.tau) is float
    assert (config.seed, config.backend) == (7, "reference")
    assert preset("varsplat-fast").seed == 0, "the preset itself is not changed"


def test_override_reaches_every_setting() -> None:
    config = Config()
    for section in dataclasses.fields(Config):
        value = getattr(config, section.name)
        if dataclasses.is_dataclass(value):
            for setting in dataclasses.fields(value):
                same = {f"{section.name}.{setting.name}": str(getattr(value, setting.name))}
                assert override(config, same) == config
        else:
            assert override(config, {section.name: str(value)}) == config


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("tracking.iteratons", "3", r"did you mean iterations\?"),
        (
            "trackng.iterations",
            "3",
            r"did you mean tracking\?.*sections: input, render, seeding, mapping, primitives, tracking",
        ),
        ("tracking", "3", "unknown setting 'tracking'"),
        ("tracking.tau.x", "3", "unknown setting"),
        ("name.upper", "3", "unknown setting"),
        ("to_dict", "3", "unknown setting"),
        (".tau", "3", "unknown setting"),
        ("", "3", "unknown setting"),
        ("tracking.iterations", "6.5", "needs a whole number, found '6.5'"),
        ("tracking.iterations", "", "needs a whole number"),
        ("tracking.tau", "warm", "needs a number, found 'warm'"),
        ("tracking.tau", "nan", "must be finite"),
        ("tracking.tau", "inf", "must be finite"),
        ("mapping.iterations", "-1", "not negative"),
        ("tracking.uncertainty", "maybe", "must be one of true"),
        ("tracking.method", "guess", "must be one of adam, align, found 'guess'"),
    ],
)
def test_override_refuses(name: str, text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as refused:
        override(Config(), {name: text})
    assert "\n" not in str(refused.value)


def test_settings_split_at_the_first_equals_sign() -> None:
    assert split_settings(["a.b=1", "name=x=y", "a.b=2"]) == {"a.b": "2", "name": "x=y"}
    with pytest.raises(ConfigError, match=r"SECTION\.NAME=VALUE, found 'tau'"):
        split_settings(["tau"])


@pytest.mark.parametrize("name", list_presets())
def test_saved_settings_load_unchanged(name: str, tmp_path: Path) -> None:
    preset(name).save(tmp_path / "config.json")
    assert Config.load(tmp_path / "config.json") == preset(name)


@pytest.mark.parametrize("text", ["{", '{"speed": 1}', '{"tracking": {"speed": 1}}'])
def test_damaged_settings_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ConfigError):
        Config.load(tmp_path / "config.json")


def test_environment_defaults_and_values() -> None:
    assert env.read({}) == env.Switches(threads=0, isa="auto", backend="auto")
    assert env.read({"SIGMASPLAT_THREADS": "", "SIGMASPLAT_ISA": ""}) == env.Switches()
    given = {"SIGMASPLAT_THREADS": "3", "SIGMASPLAT_ISA": "AVX2", "SIGMASPLAT_BACKEND": "reference"}
    assert env.read(given) == env.Switches(threads=3, isa="avx2", backend="reference")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("SIGMASPLAT_THREADS", "-1"),
        ("SIGMASPLAT_THREADS", "two"),
        ("SIGMASPLAT_THREADS", "1.5"),
        ("SIGMASPLAT_THREADS", "²"),
        ("SIGMASPLAT_ISA", "sse9"),
        ("SIGMASPLAT_BACKEND", "gpu"),
    ],
)
def test_invalid_environment_values_are_refused(name: str, text: str) -> None:
    with pytest.raises(ConfigError, match=f"{name} is {text!r}; give"):
        env.read({name: text})


def _python(code: str, **environment: str) -> str:
    kept = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    return subprocess.run(
        [sys.executable, "-c", code], env=kept | environment, capture_output=True, text=True, check=True
    ).stdout.strip()


def test_import_sets_the_wait_policy_and_loads_no_torch() -> None:
    code = "import sigmasplat, os, sys; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    assert _python(code) == "passive False"
    assert _python(code, OMP_WAIT_POLICY="active") == "active False", "the value of the user is kept"


def test_an_invalid_switch_does_not_break_the_import() -> None:
    assert _python("import sigmasplat; print('in')", SIGMASPLAT_ISA="sse9") == "in"


def test_the_public_names_exist() -> None:
    import sigmasplat

    missing = []
    for name in sigmasplat.__all__:
        try:
            getattr(sigmasplat, name)
        except ImportError as problem:
            missing.append(f"{name}: {problem}")
    assert missing == []
    assert set(sigmasplat.__all__) <= set(dir(sigmasplat))
    with pytest.raises(AttributeError, match="nothing_here"):
        _ = sigmasplat.nothing_here
