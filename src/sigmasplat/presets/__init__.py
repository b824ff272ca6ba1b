"""Give the settings of the systems by name: values only, a module for each system."""

import dataclasses

from sigmasplat.config import Config
from sigmasplat.config.text import nearest
from sigmasplat.errors import ConfigError
from sigmasplat.presets import cgslam, cgslam_released, sigma, varsplat

SYSTEMS = (varsplat.PRESETS, cgslam.PRESETS, cgslam_released.PRESETS, sigma.PRESETS)
PRESETS = {name: dataclasses.replace(config, name=name) for presets in SYSTEMS for name, config in presets.items()}


def default_preset() -> str:
    """Name the preset used where none is asked for: the one sized for a machine without a GPU."""
    return "sigma"


def list_presets() -> list[str]:
    """List every preset's name."""
    return sorted(PRESETS)


def families() -> list[str]:
    """List the presets' names in short, the default first: a pattern for each group of names that begin alike."""
    groups: dict[str, list[str]] = {}
    for name in [default_preset(), *list_presets()]:
        groups.setdefault(name.partition("-")[0], []).append(name)
    return [first if set(names) == {first} else f"{first}-*" for first, names in groups.items()]


def preset(name: str) -> Config:
    """Return a preset's settings. Raises ConfigError on an unknown name, saying which are like it, or all there are."""
    if name not in PRESETS:
        raise ConfigError(f"no preset {name!r}{_alike(name) or _any(name)}")
    return PRESETS[name]


def _alike(name: str) -> str:
    """Name the presets that begin or end with a name, empty where none does."""
    alike = [known for known in list_presets() if known.endswith(f"-{name}") or known.startswith(f"{name}-")]
    return f"; there are {', '.join(alike)} (and {len(PRESETS) - len(alike)} others)" if alike else ""


def _any(name: str) -> str:
    """Name the preset nearest to a name, and all."""
    return f"{nearest(name, PRESETS)}; there are {', '.join(list_presets())}"
