"""The default preset: every setting at its default, ours for two CPU cores."""

from sigmasplat.api import Config, Preset

PLUGIN = Preset("sigma", Config)
