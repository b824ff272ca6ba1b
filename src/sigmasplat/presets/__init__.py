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


def preset(name: str) -> Config:
    """Return a preset's settings. Raises ConfigError on an unknown name, saying which there are."""
    if name not in PRESETS:
        raise ConfigError(f"no preset {name!r}{nearest(name, PRESETS)}; there are {', '.join(list_presets())}")
    return PRESETS[name]
