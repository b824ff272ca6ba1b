"""Provide the presets by name. A preset is a set of values; each system has its own module."""

import dataclasses
from collections.abc import Mapping

from sigmasplat.config import Config
from sigmasplat.config.text import override
from sigmasplat.errors import ConfigError, nearest
from sigmasplat.registry import Preset, rows

FAMILIES = ("sigma", "cgslam-*", "loopsplat-*", "varsplat-*")
"""The names of all presets in short, the default first: a name, or a pattern for several names."""


def _presets() -> dict[str, Preset]:
    return {row.name: row for row in rows(Preset)}


def default_preset() -> str:
    """Return the name of the default preset, which is sized for a machine without a GPU."""
    return "sigma"


def list_presets() -> list[str]:
    """List the names of all presets."""
    return sorted(_presets())


def preset(name: str) -> Config:
    """Return the settings of a preset. Raises ConfigError on an unknown name, with similar names or all names."""
    if name not in _presets():
        raise ConfigError(f"no preset {name!r}{_similar(name) or _all(name)}")
    return dataclasses.replace(_presets()[name].make(), name=name)


def configured(config: Config | str | None, settings: Mapping[str, object] | None = None) -> Config:
    """Return settings, those of a preset by name, or those of the default preset, with some replaced, as in
    {"input.width": 320}.

    Raises ConfigError on an unknown preset, an unknown setting, or a value of the wrong type.
    """
    if config is not None and not isinstance(config, Config | str):
        raise ConfigError(f"settings are {type(config).__name__}; give a Config or the name of a preset")
    base = config if isinstance(config, Config) else preset(config or default_preset())
    return override(base, {name: str(value) for name, value in (settings or {}).items()})


def _similar(name: str) -> str:
    """Return text with the presets that begin or end with a name, "" if there are none."""
    similar = [known for known in list_presets() if known.endswith(f"-{name}") or known.startswith(f"{name}-")]
    return f"; known: {', '.join(similar)} (and {len(_presets()) - len(similar)} others)" if similar else ""


def _all(name: str) -> str:
    """Return text with the preset closest to a name, and all presets."""
    return f"{nearest(name, _presets())}; known: {', '.join(list_presets())}"
