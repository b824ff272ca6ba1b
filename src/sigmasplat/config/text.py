"""Change settings given as text, as on the command line: SECTION.NAME=VALUE."""

import dataclasses
import difflib
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from sigmasplat.config import Config
from sigmasplat.errors import ConfigError


def override(config: Config, settings: Mapping[str, str]) -> Config:
    """Return the settings with some replaced, as in {"tracking.iterations": "60", "seed": "1"}; text is converted.

    Raises ConfigError on an unknown name (and lists the known ones), text of another type, or a negative number.
    """
    for name, text in settings.items():
        section, _, field = name.rpartition(".")
        if not section:
            config = _replaced(config, name, name, text)
            continue
        inner = getattr(config, section, None)
        if not dataclasses.is_dataclass(inner) or isinstance(inner, type):
            sections = [f.name for f in dataclasses.fields(config) if dataclasses.is_dataclass(getattr(config, f.name))]
            raise ConfigError(f"unknown setting {name!r}{nearest(section, sections)}; sections: {', '.join(sections)}")
        config = dataclasses.replace(config, **{section: _replaced(inner, field, name, text)})
    return config


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


def _replaced(section: Any, field: str, name: str, text: str) -> Any:
    """Return a section with one value replaced; `name` is the full name that the user gave."""
    types = {known: kind for known, kind in get_type_hints(type(section)).items() if not dataclasses.is_dataclass(kind)}
    if field not in types:
        raise ConfigError(f"unknown setting {name!r}{nearest(field, types)}; known: {', '.join(types)}")
    return dataclasses.replace(section, **{field: _converted(name, types[field], text.strip())})


def _converted(name: str, kind: Any, text: str) -> Any:
    """Convert text to a setting's type. Raises ConfigError."""
    if get_origin(kind) is Literal:
        return _chosen(name, {str(value): value for value in get_args(kind)}, text)
    if kind is bool:
        words = {
            "true": True,
            "1": True,
            "yes": True,
            "on": True,
            "false": False,
            "0": False,
            "no": False,
            "off": False,
        }
        return _chosen(name, words, text.lower())
    if kind is str:
        return text
    try:
        value = kind(text)
    except ValueError:
        wanted = "a whole number" if kind is int else "a number"
        raise ConfigError(f"{name} needs {wanted}, found {text!r}") from None
    if not math.isfinite(value) or value < 0:
        raise ConfigError(f"{name} must be finite and not negative, found {text!r}")
    return value


def _chosen(name: str, allowed: Mapping[str, Any], text: str) -> Any:
    if text not in allowed:
        raise ConfigError(f"{name} must be one of {', '.join(allowed)}, found {text!r}")
    return allowed[text]


def nearest(name: str, known: Mapping[str, Any] | list[str]) -> str:
    """Return a suggestion for a misspelt name, "" if no known name is similar."""
    close = difflib.get_close_matches(name, list(known), 1)
    return f" (did you mean {close[0]}?)" if close else ""


def full_path(path: str) -> str:
    """Return the absolute path of an existing file; other text, such as the name of a built-in sequence, unchanged."""
    return str(Path(path).resolve()) if Path(path).exists() else path
