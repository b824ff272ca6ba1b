"""The presets of the papers: a row for each name. The values of a system are in a module of its own. A preset that has
nothing to do with them is a module with its own row: `sigma`."""

from functools import partial

from sigmasplat.api import Config, Preset
from sigmasplat.plugins.presets import cgslam, released_code, varsplat


def _made(config: Config) -> Config:
    return config


PLUGIN = (
    *(Preset(name, partial(_made, config)) for name, config in (varsplat.PRESETS | cgslam.PRESETS).items()),
    *(
        Preset(name, partial(released_code.released, name), partial(released_code.scenes, name))
        for name in released_code.FAMILIES
    ),
)
