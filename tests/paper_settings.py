"""Sections of settings that begin with the values of the papers (`BASE`) instead of the defaults: for tests of methods
that the defaults do not use, such as tracking by descent."""

import dataclasses
from functools import partial
from typing import Any

from constants import made
from sigmasplat import config
from sigmasplat.plugins.presets.shared_by_papers import BASE, BASE_VALUES

RenderConfig = partial(made, config.RenderConfig, **BASE_VALUES["render"])
SeedConfig = partial(made, config.SeedConfig, **BASE_VALUES["seeding"])
MappingConfig = partial(made, config.MappingConfig, **BASE_VALUES["mapping"])
DensifyConfig = partial(made, config.DensifyConfig, **BASE_VALUES["primitives"])
TrackingConfig = partial(made, config.TrackingConfig, **BASE_VALUES["tracking"])
RecoveryConfig = partial(made, config.RecoveryConfig, **BASE_VALUES["recovery"])
MovingConfig = partial(made, config.MovingConfig, **BASE_VALUES["moving"])
SubmapConfig = partial(made, config.SubmapConfig, **BASE_VALUES["submaps"])
LoopConfig = partial(made, config.LoopConfig, **BASE_VALUES["loops"])
RegistrationConfig = partial(made, config.RegistrationConfig, **BASE_VALUES["registration"])
FinalConfig = partial(made, config.FinalConfig, **BASE_VALUES["final"])
SurfaceConfig = partial(made, config.SurfaceConfig, **BASE_VALUES["surface"])
InputConfig = partial(made, config.InputConfig, **BASE_VALUES["input"])


def paper_settings(**sections: Any) -> config.Config:
    """Return the settings that the papers' presets build on, with some sections of their own."""
    return dataclasses.replace(BASE, **sections)
