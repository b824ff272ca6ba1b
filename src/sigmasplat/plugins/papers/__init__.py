"""The settings of the published systems, one module each, and the tables of their papers."""

from functools import partial
from importlib import import_module

from sigmasplat.config import Config
from sigmasplat.registry import Preset

SYSTEMS = ("varsplat", "varsplat_released", "cgslam", "cgslam_released", "sigma")


def _made(config: object) -> Config:
    """Return settings; most of the many scenes are functions that make them, because they are never used."""
    found = config if isinstance(config, Config) else config()  # type: ignore[operator]
    assert isinstance(found, Config)
    return found


PLUGIN = tuple(
    Preset(name, partial(_made, config))
    for system in SYSTEMS
    for name, config in import_module(f"{__name__}.{system}").PRESETS.items()
)
