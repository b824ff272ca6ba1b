"""The settings that the papers' presets build on, and those of the presets by data set: tables of values/*.toml."""

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from sigmasplat.api import Config, Preset

Table = Mapping[str, Mapping[str, Any]]
FOLDER = Path(__file__).parent


@cache
def read_values(name: str) -> dict[str, dict[str, Any]]:
    """Read a file of this folder: values by section, or tables by name."""
    return tomllib.loads((FOLDER / f"{name}.toml").read_text(encoding="utf-8"))


BASE_VALUES = read_values("values/shared_by_papers")
"""What is ours alone is off, and a value that both papers share is theirs; the presets name the rest."""
BASE = Config().changed(**BASE_VALUES)


def made(tables: Table, name: str) -> Config:
    """Return the settings of a table: its sections change those of the table `like`, or else those of `BASE`."""
    table = tables[name]
    base = made(tables, table["like"]) if "like" in table else BASE
    return base.changed(**{section: values for section, values in table.items() if isinstance(values, dict)})


def fixed(name: str, config: Config) -> Preset:
    """Return the row of a preset whose settings are known."""
    return Preset(name, lambda: config)
