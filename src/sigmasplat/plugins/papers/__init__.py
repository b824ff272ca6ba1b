"""The settings of the published systems, one module each, and the tables of their papers."""

from functools import partial

from sigmasplat.config import Config
from sigmasplat.plugins.papers import cgslam, released, varsplat
from sigmasplat.registry import Preset


def _made(config: Config) -> Config:
    return config


PLUGIN = (
    Preset("sigma", Config),
    *(Preset(name, partial(_made, config)) for name, config in (varsplat.PRESETS | cgslam.PRESETS).items()),
    *(Preset(name, partial(released.released, name), partial(released.scenes, name)) for name in released.FAMILIES),
)
