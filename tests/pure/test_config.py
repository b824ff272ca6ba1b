"""Settings: values that --set and the environment accept, and saving to config.json."""

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sigmasplat import env
from sigmasplat.config import SECTIONS, Config
from sigmasplat.config.find_preset import preset
from sigmasplat.config.ranges import kinds_of, problem_of, unpacked
from sigmasplat.config.text import override, split_settings
from sigmasplat.errors import ConfigError


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
        ("mapping.iterations", "-1", "at least 0"),
        ("tracking.uncertainty", "maybe", "must be one of true"),
        ("tracking.method", "guess", "must be one of adam, align, found 'guess'"),
    ],
)
def test_override_refuses(name: str, text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as refused:
        override(Config(), {name: text})
    assert "\n" not in str(refused.value)


def test_every_number_has_a_range_and_every_default_is_in_it() -> None:
    for name, section in SECTIONS.items():
        assert section.section == name
        for setting, kind in kinds_of(section).items():
            base, range_ = unpacked(kind)
            assert range_ is not None or base not in (int, float), f"{name}.{setting} declares no range"
            assert problem_of(kind, getattr(section(), setting)) is None, f"{name}.{setting}"


@pytest.mark.parametrize(
    ("section", "setting", "value"),
    [
        ("mapping", "every", 0),
        ("mapping", "every", -1),
        ("mapping", "every", 1.5),
        ("mapping", "every", True),
        ("mapping", "every", "3"),
        ("mapping", "every", 10**400),
        ("input", "width", 1),
        ("input", "width", 100_000),
        ("input", "max_depth_m", math.nan),
        ("tracking", "tau", 0.0),
        ("tracking", "tau", math.inf),
        ("tracking", "method", "guess"),
        ("tracking", "exposure", None),
        ("loops", "weights", 3),
        ("tracking", "alpha_power", -0.5),
        ("primitives", "split_scale_m", -1.0),
        ("uncertainty", "probes", -1),
    ],
)
def test_values_that_cannot_work_are_refused_in_python_and_in_files(section: str, setting: str, value: object) -> None:
    with pytest.raises(ConfigError, match=rf"^{section}\.{setting} must be ") as refused:
        Config().changed(**{section: {setting: value}})
    with pytest.raises(ConfigError, match=rf"^{section}\.{setting} must be "):
        Config.from_dict({section: {setting: value}})
    assert len(str(refused.value)) < 200


@pytest.mark.parametrize("section", [None, [], 3, "fast"])
def test_a_section_that_is_no_object_is_refused(section: object) -> None:
    with pytest.raises(ConfigError, match="mapping must be an object of settings"):
        Config.from_dict({"mapping": section})


def test_all_invalid_values_are_named_at_once() -> None:
    wrong = {"mapping.every": "0", "input.width": "1", "tracking.tau": "nan", "trackng.tau": "1", "seed": "-1"}
    with pytest.raises(ConfigError) as refused:
        override(Config(), wrong)
    assert all(name in str(refused.value) for name in wrong) and "\n" not in str(refused.value)
    with pytest.raises(ConfigError) as refused:
        Config.from_dict({"mapping": {"every": 0, "window": -1}, "input": {"width": 1}, "seed": -1, "sed": 2})
    assert all(name in str(refused.value) for name in ("mapping.every", "mapping.window", "input.width", "seed", "sed"))


def test_limits_that_depend_on_each_other_are_set_together() -> None:
    config = override(Config(), {"input.start_s": "5", "input.end_s": "9"})
    later = override(config, {"input.start_s": "20", "input.end_s": "30"})
    assert (later.input.start_s, later.input.end_s) == (20.0, 30.0)
    with pytest.raises(ConfigError, match=r"input\.end_s must be after"):
        override(config, {"input.start_s": "20"})
    with pytest.raises(ConfigError, match=r"input\.max_depth_m must be above input\.min_depth_m"):
        override(config, {"input.min_depth_m": "9"})


@pytest.mark.parametrize("text", ["camera", "-3", "1.5", "", "3"])
def test_the_width_of_the_final_map_is_a_number(text: str) -> None:
    with pytest.raises(ConfigError, match=r"final\.width (needs a whole number|must be 0 or between 8 and 8192)"):
        override(Config(), {"final.width": text})
    for good in (0, 640, 8192):
        assert override(Config(), {"final.width": str(good)}).final.width == good


def test_settings_split_at_the_first_equals_sign() -> None:
    assert split_settings(["a.b=1", "name=x=y", "a.b=2"]) == {"a.b": "2", "name": "x=y"}
    with pytest.raises(ConfigError, match=r"SECTION\.NAME=VALUE, found 'tau'"):
        split_settings(["tau"])


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


def test_environment_values_that_mean_nothing_are_refused() -> None:
    for name, text in [
        ("SIGMASPLAT_THREADS", "-1"),
        ("SIGMASPLAT_THREADS", "two"),
        ("SIGMASPLAT_THREADS", "1.5"),
        ("SIGMASPLAT_THREADS", "²"),
        ("SIGMASPLAT_ISA", "sse9"),
    ]:
        with pytest.raises(ConfigError, match=f"{name} is {text!r}; give"):
            env.read({name: text})


def test_a_backend_of_another_name_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"no backend 'cpuu' \(did you mean cuda|no backend 'cpuu'"):
        Config(backend="cpuu")
    assert Config(backend="cuda").backend == "cuda"


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


def test_a_saved_setting_of_another_version_is_refused_in_one_line() -> None:
    saved = preset("sigma").to_dict()
    saved["registration"]["keyframes"] = 5
    saved["loops"]["variance"] = "predicted"
    with pytest.raises(ConfigError) as refused:
        Config.from_dict(saved)
    said = str(refused.value)
    assert "unknown setting registration.keyframes (known: " in said
    assert "unknown setting loops.variance (known: " in said
    assert "\n" not in said
    with pytest.raises(ConfigError, match=r"^unknown setting 'loops\.variance'"):
        override(preset("sigma"), {"loops.variance": "predicted"})
