"""Define every setting of a run: frozen dataclasses with units in the names. The values of each system are in
`presets`."""

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, get_args, get_origin

from sigmasplat.config.frames import DensifyConfig, MappingConfig, RenderConfig, SeedConfig
from sigmasplat.config.input import RECORDED_POSES, InputConfig
from sigmasplat.config.ranges import Count, Section, kinds_of, problems_of, refuse, shown, unpacked
from sigmasplat.config.run import (
    FeatureConfig,
    MovingConfig,
    RealTimeConfig,
    RecoveryConfig,
    SurfaceConfig,
    UncertaintyConfig,
)
from sigmasplat.config.submaps import FinalConfig, LoopConfig, RegistrationConfig, SubmapConfig
from sigmasplat.config.tracking import TrackingConfig
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
        followers = dict[str, object]()
        for name, value in values.items():
            if name not in known:
                problems.append(f"unknown setting {name!r} (known: {', '.join(sorted(known))})")
            elif name in SECTIONS and isinstance(value, dict):
                names = kinds_of(SECTIONS[name])
                others = {f"{name}.{key}": value[key] for key in sorted(set(value) - set(names))}
                old = {key: others.pop(key) for key in sorted(others.keys() & FOLLOWS)}
                ours = {key: item for key, item in value.items() if key in names}
                try:
                    found[name] = SECTIONS[name](**(_choices(name, old, _scale(values)) | ours))
                    followers |= old
                except ConfigError as problem:
                    problems.append(str(problem))
                for key, item in others.items():
                    problems += _unknown(key, item, names, _scale(values))
            else:
                found[name] = value
        try:
            config = Config(**found)
            problems += _misfits(config, followers)
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


def _misfits(config: Config, saved: Mapping[str, object]) -> Iterator[str]:
    """Yield what is wrong with saved values of settings that follow others now: those that the others do not give, in
    a scene of this scale."""
    for name, value in sorted(saved.items()):
        section, _, key = name.partition(".")
        given = UNLIKE[name](config) if name in UNLIKE else (getattr(getattr(config, section), key),)
        if not any(_same(each, value, config.render.scene_scale) for each in given):
            yield f"{said_gone(name)}, found {shown(value)}"


def _same(ours: object, saved: object, scale: float = 1.0) -> bool:
    """Return whether a saved value is ours up to rounding, or ours times the scale of the scene."""
    if isinstance(ours, float) and isinstance(saved, float):
        return math.isclose(ours, saved, rel_tol=1e-12) or math.isclose(ours * scale, saved, rel_tol=1e-12)
    return ours == saved


def _choices(section: str, saved: Mapping[str, object], scale: float) -> dict[str, object]:
    """Return the choices of a section that saved values of the settings spell out which they replaced."""
    kind, found = SECTIONS[section], dict[str, object]()
    for leader in {FOLLOWS[name] for name in saved if FOLLOWS[name].startswith(f"{section}.")}:
        key = leader.partition(".")[2]
        old = {name.partition(".")[2]: value for name, value in saved.items() if FOLLOWS[name] == leader}
        type_ = unpacked(kinds_of(kind)[key])[0]
        for choice in (True, False) if type_ is bool else get_args(type_):
            made = kind(**{key: choice})
            if all(_same(getattr(made, name), value, scale) for name, value in old.items()):
                found[key] = choice
                break
    return found


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
    "render.low_pass_px2": 0.3, "render.depth_gate_m": 0.0, "render.mean_pose_gradient": True,
    "render.depth_pose_gradient": True,
    "render.color_pose_gradient": True, "seeding.voxel_m": 0.0, "seeding.voxel_most": 8,
    "seeding.sensor_noise": False, "mapping.color_covariance": "diagonal", "mapping.keyframe_history": 0,
    "primitives.uncertain_by": "centre", "primitives.most_radius_px": 0.0, "tracking.align_to": "keyframe",
    "tracking.motion_model": True, "mapping.sensor_noise": False,
    "input.depth_model": "", "input.depth_model_colors": "imagenet", "input.depth_model_size": 0,
    "input.depth_model_output": "", "input.depth_model_threads": 1,
    "input.stereo_disparities": 0, "input.stereo_std_px": 0.15, "input.stereo_max_std": 0.05,
    "registration.plateau_stop": 1e-4, "registration.plateau_window": 10,
    "tracking.update_stop": 0.0, "tracking.variance": "published", "submaps.variance_sum": 0.0,
    "loops.variance": "published", "registration.variance": "published", "final.variance": "published",
    "surface.sensor_noise": False,
}  # fmt: skip
"""Settings of methods that are gone, with the value that was their absence."""
REPLACED = {
    "seeding.shape": ("scale_from", "scale_factor", "thickness", "opacity", "density"),
    "seeding.outliers": ("outlier_neighbours", "outlier_first"),
    "seeding.depth_error_factor": ("alpha_below", "push_back"),
    "mapping.few_steps": ("newest_probability", "lr_opacity_logits", "lr_log_variances"),
    "mapping.adjustment": ("frames_per_step", "poses", "poses_from", "covisibility"),
    "mapping.colors": ("freeze_old_colors", "freeze_new_colors", "freeze_until", "fresh_adam"),
    "tracking.exposure": ("mapping.exposure",),
    "mapping.divided": ("loops.slices_per_frame",),
    "primitives.densify": ("split_gradient", "clone"), "primitives.split_scale_m": ("most_scale_m",),
    "primitives.uncertain_m2": ("owner",),
    "tracking.descent": (
        "parametrisation", "average", "outlier_factor_color", "amsgrad", "first_iterations", "first_lr_rotation",
    ),
    "tracking.verify": ("sensor_noise",), "submaps.distance_m": ("angle_deg",),
    "recovery.relocalise": ("steady_frames", "new_map_after"), "loops.descriptor": ("similarity_floor",),
    "registration.method": ("lr_rotation", "lr_translation", "color_mean", "target", "to_keyframe"),
    "final.schedule": (
        "order", "exposure", "sh_every", "merge_m", "lr_means_last", "lr_factor", "lr_log_scales", "lr_decay", "beta2",
        "prune_weight_px", "weight_moment", "max_axis_ratio", "max_needle_ratio",
    ),
    "final.move_poses": ("lr_pose_translation", "lr_pose_rotation", "pose_reach_m", "pose_reach_most_m"),
}  # fmt: skip
"""The settings of earlier versions that each setting replaced; its value gives theirs. A name without a section is of
the same section."""
FOLLOWS = {
    old if "." in old else f"{new.partition('.')[0]}.{old}": new for new, names in REPLACED.items() for old in names
}
"""Settings of earlier versions that are a function of another one now, with its name."""
UNLIKE: dict[str, Callable[[Config], tuple[object, ...]]] = {
    "loops.slices_per_frame": lambda config: (3 if config.mapping.divided else 0,),
    "loops.similarity_floor": lambda config: (config.loops.similarity_floor,) if config.loops.close else (0.0, 0.8),
    "mapping.exposure": lambda config: (config.mapping.exposure,) if config.tracking.exposure else (True, False),
    "seeding.outlier_first": lambda config: (
        (config.seeding.outlier_first,) if config.seeding.outliers != "keep" else (True, False)
    ),
    "primitives.owner": lambda config: ("dominant",) if config.primitives.uncertain_m2 else ("dominant", "median"),
}
"""The values with which a run has the same result, of those that are no property of their section or matter only with
another setting."""
SECTIONS: dict[str, type[Section]] = {
    f.name: f.type for f in dataclasses.fields(Config) if isinstance(f.type, type) and issubclass(f.type, Section)
}
"""The class of each section by its name in `Config`."""
