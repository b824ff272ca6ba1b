"""Define every setting of a run: frozen dataclasses with units in the names. The values of each system are in
`presets`."""

import dataclasses
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, get_origin

from sigmasplat.config.frames import DensifyConfig, MappingConfig, RenderConfig, SeedConfig, TrackingConfig
from sigmasplat.config.input import RECORDED_POSES, InputConfig
from sigmasplat.config.ranges import Count, Section, kinds_of, problems_of, refuse, shown
from sigmasplat.config.run import (
    FeatureConfig,
    MovingConfig,
    RealTimeConfig,
    RecoveryConfig,
    SurfaceConfig,
    UncertaintyConfig,
)
from sigmasplat.config.submaps import FinalConfig, LoopConfig, RegistrationConfig, SubmapConfig
from sigmasplat.errors import ConfigError
from sigmasplat.files.reading import read_json
from sigmasplat.registry import Backend, named

__all__ = [
    "RECORDED_POSES", "Config", "DensifyConfig", "FeatureConfig", "FinalConfig", "InputConfig", "LoopConfig",
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
    """Renderer: auto = the value of SIGMASPLAT_BACKEND if it is set, else cpu; cuda needs an NVIDIA GPU; reference is
    slow plain torch, which defines the kernels; or the name of a plug-in."""
    input: InputConfig = field(default_factory=InputConfig)
    render: RenderConfig = field(default_factory=RenderConfig)
    seeding: SeedConfig = field(default_factory=SeedConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    primitives: DensifyConfig = field(default_factory=DensifyConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
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

    def save(self, path: Path) -> None:
        """Write the settings as JSON."""
        path.write_text(json.dumps(self.to_dict(), indent=2) + "\n")

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
                others = {f"{name}.{key}": value[key] for key in sorted(set(value) - set(names))}
                try:
                    found[name] = SECTIONS[name](**{key: item for key, item in value.items() if key in names})
                    problems += _misfits(found[name], {key: others.pop(key) for key in others.keys() & FOLLOWS})
                except ConfigError as problem:
                    problems.append(str(problem))
                for key, item in others.items():
                    problems += _unknown(key, item, names, _scale(values))
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


def _unknown(name: str, value: object, known: Iterable[str], scale: float) -> list[str]:
    """Return what is wrong with a saved value of a setting that is not a setting: nothing if it is the value that
    every run has now, or this length in a scene of another scale."""
    if name not in gone():
        return [f"unknown setting {name} (known: {', '.join(sorted(known))})"]
    only = gone()[name]
    same = value == only or (isinstance(only, float) and name.endswith("_m") and value == only * scale)
    return [] if same else [f"{said_gone(name)}, found {shown(value)}"]


def _misfits(section: Section, saved: Mapping[str, object]) -> Iterator[str]:
    """Yield what is wrong with saved values of settings that follow others now: those that the others do not give."""
    for name, value in sorted(saved.items()):
        if value != getattr(section, name.partition(".")[2]):
            yield f"{said_gone(name)}, found {shown(value)}"


def _scale(values: Mapping[str, Any]) -> float:
    """Return the scale of the scene in saved settings."""
    render = values.get("render")
    scale = render.get("scene_scale") if isinstance(render, dict) else None
    return scale if isinstance(scale, float) else 1.0


def said_gone(name: str) -> str:
    """Return what to say about a setting that is gone."""
    if name in FOLLOWS:
        return f"setting {name} is gone: its value follows {FOLLOWS[name]}"
    return f"setting {name} is gone: its value is always {gone()[name]}"


def _is_constant(type_: Any) -> bool:
    origin: object = get_origin(type_)
    return origin is ClassVar


@cache
def gone() -> dict[str, object]:
    """Return the settings of earlier versions that are constants now, or of methods that are gone, with the value that
    every run has now."""
    constants = {
        f"{section}.{name}": getattr(kind, name)
        for section, kind in SECTIONS.items()
        for name, type_ in kind.__annotations__.items()
        if _is_constant(type_)
    }
    return constants | GONE


GONE: dict[str, object] = {
    "render.depth_gate_m": 0.0, "render.mean_pose_gradient": True, "render.depth_pose_gradient": True,
    "render.color_pose_gradient": True, "seeding.voxel_m": 0.0, "seeding.voxel_most": 8,
    "seeding.sensor_noise": False, "mapping.color_covariance": "diagonal", "mapping.keyframe_history": 0,
    "primitives.uncertain_by": "centre", "primitives.most_radius_px": 0.0, "tracking.align_to": "keyframe",
    "tracking.motion_model": True,
    "tracking.update_stop": 0.0, "tracking.variance": "published", "submaps.variance_sum": 0.0,
    "loops.variance": "published", "registration.variance": "published", "final.variance": "published",
    "surface.sensor_noise": False,
}  # fmt: skip
"""Settings of methods that are gone, with the value that was their absence."""
FOLLOWS = {
    "seeding.opacity": "seeding.scale_from", "seeding.density": "seeding.scale_from",
    "tracking.outlier_factor_color": "tracking.average", "submaps.angle_deg": "submaps.distance_m",
    "seeding.alpha_below": "seeding.depth_error_factor", "seeding.push_back": "seeding.depth_error_factor",
    "mapping.freeze_until": "mapping.freeze_new_colors", "mapping.fresh_adam": "mapping.freeze_new_colors",
    "tracking.sensor_noise": "tracking.verify", "tracking.first_lr_rotation": "tracking.first_iterations",
    "recovery.steady_frames": "recovery.relocalise", "recovery.new_map_after": "recovery.relocalise",
    "final.lr_factor": "final.order", "final.lr_log_scales": "final.order", "final.lr_decay": "final.order",
    "final.beta2": "final.order", "final.prune_weight_px": "final.order", "final.weight_moment": "final.order",
    "final.max_axis_ratio": "final.order", "final.max_needle_ratio": "final.order",
}  # fmt: skip
"""Settings of earlier versions that are a function of another one now, with its name."""
SECTIONS: dict[str, type[Section]] = {
    f.name: f.type for f in dataclasses.fields(Config) if isinstance(f.type, type) and issubclass(f.type, Section)
}
"""The class of each section by its name in `Config`."""
