"""Define every setting of a run: frozen dataclasses with units in the names. The values of each system are in
`presets`."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sigmasplat.config.final import FinalConfig, SurfaceConfig, UncertaintyConfig
from sigmasplat.config.input import RECORDED_POSES, InputConfig
from sigmasplat.config.mapping import DensifyConfig, MappingConfig, RenderConfig, SeedConfig
from sigmasplat.config.ranges import Count, Section, kinds_of, problems_of, refuse, shown
from sigmasplat.config.submaps import LoopConfig, RegistrationConfig, SubmapConfig
from sigmasplat.config.tracking import MovingConfig, RealTimeConfig, RecoveryConfig, TrackingConfig
from sigmasplat.errors import ConfigError
from sigmasplat.files.reading import read_json
from sigmasplat.registry import Backend, named

__all__ = [
    "RECORDED_POSES", "Config", "DensifyConfig", "FinalConfig", "InputConfig", "LoopConfig",
    "MappingConfig", "MovingConfig", "RealTimeConfig", "RecoveryConfig", "RegistrationConfig", "RenderConfig",
    "SeedConfig", "SubmapConfig", "SurfaceConfig", "TrackingConfig", "UncertaintyConfig",
]  # fmt: skip

OWN_BACKENDS = ("auto", "cpu", "cuda", "reference")
"""The values of `backend` that need no plug-in of others."""


@dataclass(frozen=True)
class Config:
    """All settings of a run. Every value has a working default; `find_preset.preset` returns those of a
    published system."""

    name: str = "custom"
    """Name of these settings in reports and folder names: the name of the preset."""
    seed: Count = 0
    """Seed of all random numbers. Runs with other seeds show how much a result depends on chance."""
    backend: str = "auto"
    """Renderer: auto = the value of SIGMASPLAT_BACKEND if it is set, else a GPU whose self-test passes, else cpu; cuda
    needs an NVIDIA GPU; reference is slow plain torch, which defines the kernels; or the name of a plug-in."""
    input: InputConfig = field(default_factory=InputConfig)
    render: RenderConfig = field(default_factory=RenderConfig)
    seeding: SeedConfig = field(default_factory=SeedConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    primitives: DensifyConfig = field(default_factory=DensifyConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    recovery: RecoveryConfig = field(default_factory=RecoveryConfig)
    moving: MovingConfig = field(default_factory=MovingConfig)
    submaps: SubmapConfig = field(default_factory=SubmapConfig)
    loops: LoopConfig = field(default_factory=LoopConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    final: FinalConfig = field(default_factory=FinalConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    uncertainty: UncertaintyConfig = field(default_factory=UncertaintyConfig)
    realtime: RealTimeConfig = field(default_factory=RealTimeConfig)

    def __post_init__(self) -> None:
        others = [name for name, section in SECTIONS.items() if not isinstance(getattr(self, name), section)]
        sections = (f"{name} must be an object of settings, found {shown(getattr(self, name))}" for name in others)
        refuse([*problems_of(self), *sections])
        asked = self.backend
        if asked not in OWN_BACKENDS:
            named((Backend,), asked)

    def changed(self, **sections: Mapping[str, Any]) -> "Config":
        """Return the settings with some values replaced, as in config.changed(mapping={"every": 5})."""
        new = {name: dataclasses.replace(getattr(self, name), **values) for name, values in sections.items()}
        return dataclasses.replace(self, **new)

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as nested dicts, as in a run's config.json."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_dict(values: dict[str, Any]) -> "Config":
        """Make settings from nested dicts. Raises ConfigError with every unknown name and every invalid value."""
        if not isinstance(values, dict):
            raise ConfigError(f"settings must be an object of sections, found {shown(values)}")
        known, found, problems = {f.name for f in dataclasses.fields(Config)}, dict[str, Any](), list[str]()
        for name, value in values.items():
            if name not in known:
                problems.append(f"unknown setting {name!r} (known: {', '.join(sorted(known))})")
            elif name in SECTIONS and isinstance(value, dict):
                names = kinds_of(SECTIONS[name])
                try:
                    found[name] = SECTIONS[name](**{key: item for key, item in value.items() if key in names})
                except ConfigError as problem:
                    problems.append(str(problem))
                for key in sorted(set(value) - set(names)):
                    problems.append(f"unknown setting {name}.{key} (known: {', '.join(sorted(names))})")
            else:
                found[name] = value
        try:
            config = Config(**found)
        except ConfigError as problem:
            problems.append(str(problem))
        refuse(problems)
        return config

    @staticmethod
    def load(path: Path) -> "Config":
        """Read a config.json. Raises ConfigError if it is missing, not JSON, or has unknown settings."""
        values = read_json(path, ConfigError)
        try:
            return Config.from_dict(values)
        except ConfigError as problem:
            raise ConfigError(f"{path}: {problem}") from problem


SECTIONS: dict[str, type[Section]] = {
    f.name: f.type for f in dataclasses.fields(Config) if isinstance(f.type, type) and issubclass(f.type, Section)
}
"""The class of each section by its name in `Config`."""
