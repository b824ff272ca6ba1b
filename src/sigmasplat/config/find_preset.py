"""Find a preset by its name. The presets are in `plugins/presets`; `sigma` is the default of every setting."""

import dataclasses
from collections.abc import Mapping

from sigmasplat.config import Config
from sigmasplat.config.text import override
from sigmasplat.errors import ConfigError, nearest
from sigmasplat.registry import Preset, rows

FAMILIES = ("sigma", "cgslam-*", "loopsplat-*", "varsplat-*")
"""The names of all presets in short, the default first: a name, or a pattern for several names."""


def default_preset() -> str:
    """Return the name of the default preset, which is sized for a machine without a GPU."""
    return "sigma"


def list_presets() -> list[str]:
    """List the names of all presets that need no scene; `presets_by_scene` lists the others."""
    return sorted(row.name for row in rows(Preset) if row.scenes is None)


def presets_by_scene() -> list[str]:
    """List the names of presets with a scene, as in `varsplat-released-room0`."""
    return [f"{row.name}-{scene}" for row in rows(Preset) if row.scenes is not None for scene in row.scenes()]


def is_preset(name: str) -> bool:
    """Return whether there is a preset of this name, with a scene if it needs one."""
    return name in list_presets() or name.replace(":", "-", 1) in presets_by_scene()


def preset(name: str) -> Config:
    """Return the settings of a preset; a scene follows its name, as in `varsplat-released:room0`. Raises ConfigError on
    an unknown name, with similar names or all names, and on an unknown scene, with all scenes."""
    name = name.replace(":", "-", 1)
    for row in rows(Preset):
        if row.scenes is None and name == row.name:
            return _named(row.make(), name)
        if row.scenes is not None and f"{name}-".startswith(f"{row.name}-"):
            return _named(row.make(name[len(row.name) + 1 :]), name)
    raise ConfigError(f"no preset {name!r}{_similar(name) or _all(name)}")


def _named(config: Config, name: str) -> Config:
    return dataclasses.replace(config, name=name)


def configured(config: Config | str | None, settings: Mapping[str, object] | None = None) -> Config:
    """Return settings, those of a preset by name, or those of the default preset, with some replaced, as in
    {"input.width": 320}.

    Raises ConfigError on an unknown preset, an unknown setting, or a value of the wrong type.
    """
    if config is not None and not isinstance(config, Config | str):
        raise ConfigError(f"settings are {type(config).__name__}; give a Config or the name of a preset")
    if config is None:
        config = _named(Config(), default_preset())
    base = config if isinstance(config, Config) else preset(config)
    return override(base, {name: str(value) for name, value in (settings or {}).items()})


def _similar(name: str) -> str:
    """Return text with the presets that begin or end with a name, "" if there are none."""
    every = [*list_presets(), *presets_by_scene()]
    similar = [known for known in every if known.endswith(f"-{name}") or known.startswith(f"{name}-")]
    return f"; known: {', '.join(similar)} (and {len(every) - len(similar)} others)" if similar else ""


def _all(name: str) -> str:
    """Return text with the preset closest to a name, and all presets."""
    known = [*list_presets(), *(f"{row.name}-SCENE" for row in rows(Preset) if row.scenes is not None)]
    return f"{nearest(name, known)}; known: {', '.join(known)}"
