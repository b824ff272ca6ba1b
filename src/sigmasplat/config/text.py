"""Change settings given as text, as on the command line: SECTION.NAME=VALUE."""

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from sigmasplat.config import SECTIONS, Config
from sigmasplat.config.ranges import kinds_of, problem_of, refuse, shown, unpacked
from sigmasplat.errors import ConfigError, nearest


def override(config: Config, settings: Mapping[str, str]) -> Config:
    """Return the settings with some replaced, as in {"tracking.iterations": "60", "seed": "1"}; text is converted.

    Raises ConfigError with every unknown name (and the known ones), text of another type, and value out of range.
    """
    changes: dict[str, dict[str, Any]] = {}
    problems: list[str] = []
    for name, text in settings.items():
        section, _, field = name.rpartition(".")
        try:
            changes.setdefault(section, {})[field] = _converted(name, _kind(config, section, field, name), text.strip())
        except ConfigError as problem:
            problems.append(str(problem))
    made: dict[str, Any] = changes.pop("", {})
    kinds = kinds_of(Config)
    problems += [f"{name} {wrong}" for name, value in made.items() if (wrong := problem_of(kinds[name], value))]
    for section, values in changes.items():
        try:
            made[section] = dataclasses.replace(getattr(config, section), **values)
        except ConfigError as problem:
            problems.append(str(problem))
    refuse(problems)
    return dataclasses.replace(config, **made)


def split_settings(settings: Iterable[str]) -> dict[str, str]:
    """Split SECTION.NAME=VALUE at the equals sign; the last value of a name given twice is used. Raises ConfigError."""
    pairs = [setting.partition("=") for setting in settings]
    for name, equals, _ in pairs:
        if not equals:
            raise ConfigError(f"a setting must be SECTION.NAME=VALUE, found {name!r}")
    return {name.strip(): value for name, _, value in pairs}


def differences(config: Config, base: Config) -> list[str]:
    """Return the settings of `config` that differ from those of `base`, except its name, as SECTION.NAME=VALUE."""
    ours, theirs = _flat(dataclasses.asdict(config)), _flat(dataclasses.asdict(base))
    return [f"{name}={value}" for name, value in ours.items() if value != theirs[name] and name != "name"]


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested values by the name SECTION.NAME."""
    inner = {key: value if isinstance(value, Mapping) else None for key, value in values.items()}
    flat = {key: value for key, value in values.items() if inner[key] is None}
    return flat | {f"{key}.{name}": item for key, section in inner.items() if section for name, item in section.items()}


def _kind(config: Config, section: str, field: str, name: str) -> Any:
    """Return the type of a setting with its range; `name` is the full name that the user gave. Raises ConfigError."""
    if section and section not in SECTIONS:
        raise ConfigError(f"unknown setting {name!r}{nearest(section, SECTIONS)}; sections: {', '.join(SECTIONS)}")
    kinds = kinds_of(SECTIONS[section] if section else type(config))
    if field not in kinds or (not section and field in SECTIONS):
        known = [known for known in kinds if section or known not in SECTIONS]
        raise ConfigError(f"unknown setting {name!r}{nearest(field, known)}; known: {', '.join(known)}")
    return kinds[field]


def _converted(name: str, kind: Any, text: str) -> Any:
    """Convert text to a setting's type. Raises ConfigError if it is not of this type; the section checks its range."""
    base, _ = unpacked(kind)
    if get_origin(base) is Literal:
        return _chosen(name, {str(value): value for value in get_args(base)}, text)
    if base is bool:
        words = dict.fromkeys(("true", "1", "yes", "on"), True) | dict.fromkeys(("false", "0", "no", "off"), False)
        return _chosen(name, words, text.lower())
    if base is str:
        return text
    try:
        return base(text)
    except ValueError:
        wanted = "a whole number" if base is int else "a number"
        raise ConfigError(f"{name} needs {wanted}, found {shown(text)}") from None


def _chosen(name: str, allowed: Mapping[str, Any], text: str) -> Any:
    if text not in allowed:
        raise ConfigError(f"{name} must be one of {', '.join(allowed)}, found {text!r}")
    return allowed[text]


def full_path(path: str) -> str:
    """Return the absolute path of an existing file; other text, such as the name of a built-in sequence, unchanged."""
    return str(Path(path).resolve()) if Path(path).exists() else path
