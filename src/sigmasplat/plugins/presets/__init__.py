"""The presets: a row for each name. The values of a published system are in a module of its own."""

from functools import partial

from sigmasplat.api import Config, Preset
from sigmasplat.plugins.presets import cgslam, released, varsplat


def _made(config: Config) -> Config:
    return config


PLUGIN = (
    Preset("sigma", Config),
    *(Preset(name, partial(_made, config)) for name, config in (varsplat.PRESETS | cgslam.PRESETS).items()),
    *(Preset(name, partial(released.released, name), partial(released.scenes, name)) for name in released.FAMILIES),
)
