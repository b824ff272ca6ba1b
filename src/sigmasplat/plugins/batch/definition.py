"""The definition of a table: scenes, systems, scores and published numbers. The format: docs/tables.md."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, get_type_hints

import sigmasplat.api as api
from sigmasplat.api import ConfigError
from sigmasplat.plugins.batch.job import Job
from sigmasplat.plugins.presets.shared_by_papers import read_values
from sigmasplat.plugins.presets.table_files import read_table

MEAN = "mean"
"""The name of the column with the mean over scenes."""
MOST_DIGITS = 15


@dataclass(frozen=True)
class Scene:
    """A scene: its name in the table, and the path of its sequence below the folder of the data."""

    name: str
    path: str


@dataclass(frozen=True)
class System:
    """Settings to run: a preset, in whose name {scene} is replaced by the scene's name, and changes to it."""

    name: str
    preset: str
    settings: Mapping[str, str] = field(default_factory=dict)
    default: bool = True


@dataclass(frozen=True)
class Score:
    """A score: where its value is in the record of a run, and how it is shown, as value × factor in `unit`.

    keys: names such as "ate.rmse_m"; the first one that has a value is taken. better: "less" or "more".
    """

    name: str
    keys: Sequence[str]
    unit: str = ""
    factor: float = 1.0
    digits: int = 2
    better: str = "less"

    def __post_init__(self) -> None:
        if isinstance(self.digits, int) and not 0 <= self.digits <= MOST_DIGITS:
            raise ValueError(f"score {self.name!r} has {self.digits} digits, allowed are 0 to {MOST_DIGITS}")

    @property
    def title(self) -> str:
        """Return name, unit, and an arrow in the better direction."""
        arrow = "↑" if self.better == "more" else "↓"
        return f"{self.name} [{self.unit}] {arrow}" if self.unit else f"{self.name} {arrow}"

    def value(self, record: Mapping[str, Any]) -> float | None:
        """Return the score of a run in its unit, None if the run does not have it."""
        for key in self.keys:
            found: Any = record
            for part in key.split("."):
                found = found.get(part) if isinstance(found, Mapping) else None
            if isinstance(found, int | float) and abs(found) <= api.MOST_NUMBER:
                return self.factor * found
        return None


@dataclass(frozen=True)
class Published:
    """The published numbers of a system: by score, then by scene; "mean" is that over the scenes."""

    system: str
    source: str
    scores: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True)
class Table:
    """A table: what to run and what to show. `folders` are places below the data where scenes may be."""

    name: str
    title: str
    scenes: Sequence[Scene]
    systems: Sequence[System]
    scores: Sequence[Score]
    published: Sequence[Published] = ()
    folders: Sequence[str] = ("",)
    notes: Sequence[str] = ()
    mesh: bool = False
    limit: int = 0

    @staticmethod
    def read(name: str) -> "Table":
        """Read a definition. Raises ConfigError if it is unknown or not valid."""
        values, shared = read_table(name), read_values("values/tables")
        parts = {"scenes": Scene, "systems": System, "scores": Score, "published": Published}
        with api.guarded(f"table {name}", "docs/tables.md shows a definition", ConfigError, "not valid"):
            values = (shared["data"][values.pop("data")] if "data" in values else {}) | values
            named = [{"name": s} | shared["scores"][s] if isinstance(s, str) else s for s in values.get("scores", [])]
            source = {"source": values.pop("source")} if "source" in values else {}
            values |= {"scores": named, "published": [source | row for row in values.get("published", [])]}
            built: dict[str, Any] = {
                key: tuple(_typed(kind(**row)) for row in values.pop(key, [])) for key, kind in parts.items()
            }
            table: Table = _typed(Table(name=name.rpartition("/")[2].removesuffix(".toml"), **built, **values))
        known, scenes = {score.name for score in table.scores}, {scene.name for scene in table.scenes} | {MEAN}
        for published in table.published:
            strange = [
                *(set(published.scores) - known),
                *({s for row in published.scores.values() for s in row} - scenes),
            ]
            if strange:
                raise ConfigError(f"table {name} is not valid: {published.system} has numbers of {strange[0]!r}")
        return table

    def with_systems(self, names: Sequence[str]) -> "Table":
        """Return the table with some of its systems only, or presets, whose name may end in {scene}; without names,
        with its default systems.

        Raises ConfigError on an unknown name.
        """
        of_table = {system.name: system for system in self.systems}
        presets = [*api.list_presets(), *api.presets_by_scene()]
        ends = [f"-{scene.name}" for scene in self.scenes]
        presets += [f"{name.removesuffix(end)}-{{scene}}" for end in ends for name in presets if name.endswith(end)]
        known = of_table | {name: System(name, name) for name in presets if name not in of_table}
        for name in names:
            if name not in known:
                there = f"{', '.join(of_table)}, and all presets"
                raise ConfigError(f"table {self.name} has no system {name!r}{api.nearest(name, known)}; it has {there}")
        chosen = [known[name] for name in dict.fromkeys(names)]
        return replace(self, systems=tuple(chosen or (system for system in self.systems if system.default)))

    def cells(
        self, seeds: int, settings: Mapping[str, str], limit: int | None = None, scenes: Sequence[str] = ()
    ) -> list["Cell"]:
        """List the runs: each seed of each scene, or of `scenes`, with each system. `settings` apply to all of them.

        Raises ConfigError on an unknown scene or setting.
        """
        known = [scene.name for scene in self.scenes]
        for name in scenes:
            if name not in known:
                there = ", ".join(known)
                raise ConfigError(f"table {self.name} has no scene {name!r}{api.nearest(name, known)}; it has {there}")
        return [
            Cell(scene.name, system.name, seed, self._job(scene, system, seed, settings, limit))
            for seed in range(seeds) for scene in self.scenes if not scenes or scene.name in scenes
            for system in self.systems
        ]  # fmt: skip

    def _job(self, scene: Scene, system: System, seed: int, settings: Mapping[str, str], limit: int | None) -> Job:
        length = {"input.limit": str(self.limit if limit is None else limit)}
        chosen = api.preset(system.preset.replace("{scene}", scene.name))
        config: api.Config = api.override(chosen, length | dict(system.settings) | dict(settings) | {"seed": str(seed)})
        paths = tuple(f"{folder}/{scene.path}".lstrip("/") for folder in self.folders)
        name = "".join(
            c if c.isalnum() or c in "._-" else "-" for c in f"{scene.name}-{system.name}-seed{seed}".lower()
        )
        return Job(name, paths, config, self.mesh, (*dict(system.settings), *settings))


@dataclass(frozen=True)
class Cell:
    """One run of a table: its scene, system and seed, and its job."""

    scene: str
    system: str
    seed: int
    job: Job


def _typed(part: Any) -> Any:
    """Return a part of a definition. Raises TypeError if a value is not of the type of its field."""
    hints = get_type_hints(type(part))
    for each in fields(part):
        if not api.fits(value := getattr(part, each.name), hints[each.name]):
            raise TypeError(f"{each.name} of a {type(part).__name__.lower()} cannot be {value!r:.60}")
    return part
