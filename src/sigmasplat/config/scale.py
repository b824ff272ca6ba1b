"""Scale all settings that are lengths to a scene that is larger than a room."""

from collections.abc import Collection, Mapping
from typing import Any

from sigmasplat.config import Config

POWERS = {
    "input": {"min_depth_m": 1, "max_depth_m": 1},
    "render": {"scene_scale": 1, "near_m": 1},
    "seeding": {"depth_error_least_m": 1, "min_distance_m": 1},
    "mapping": {
        "weight_depth": -1, "weight_mean_depth": -1, "weight_alignment": -1, "weight_isotropy": -1,
        "weight_moment": -2, "lr_means": 1, "lr_means_first": 1, "lr_pose_translation": 1,
    },
    "primitives": {"uncertain_m2": 2, "split_scale_m": 1},
    "tracking": {"lr_translation": 1},
    "submaps": {"distance_m": 1, "uncertainty_m": 1},
    "loops": {"near_m": 1},
}  # fmt: skip
"""The power of a length in each setting. Weights of losses in metres have −1, so that a loss keeps its value."""

POSES_STAY: Mapping[str, Mapping[str, object]] = {
    "mapping": {"lr_pose_translation": 0.0, "lr_pose_rotation": 0.0},
    "final": {"move_poses": False},
    "loops": {"close": False},
}
"""Settings for given poses (`input.poses`): nothing moves them."""

LEAST_GRAY = 0.5
"""Least `tracking.align_weight_color` where depth is computed from a stereo pair: neighbouring readings come from the
same pixels and have the same errors, so many of them say less than their number."""

PREDICTED_NOISE_PER_M = 0.1
"""`render.depth_noise_per_m` for predicted depth: about 10 % of the depth in a room."""


def for_scene(
    config: Config, scene_scale: float, depth_noise_per_m: float | None, given: Collection[str] = (),
    sensor: str | None = None, predicted_depth: bool = False,
) -> Config:  # fmt: skip
    """Return the settings for a scene of this size, depth of this noise, and this sensor (None = unknown, the setting
    stays); predicted_depth: whether a network predicted depth, which is then fitted to the map; other depth of a known
    noise is that of a stereo pair. Poses that `input.poses` gives stay as they are.

    given: names of settings that keep their values, as in ["input.max_depth_m"].
    """
    config = scaled(config, scene_scale, given)
    if config.input.poses:
        config = config.changed(**_not_given(POSES_STAY, given))
    if sensor is not None and config.input.sensor == "auto":
        config = config.changed(input={"sensor": sensor})
    if predicted_depth:
        depth_noise_per_m = depth_noise_per_m or PREDICTED_NOISE_PER_M
        if "tracking.fit_depth" not in given:
            config = config.changed(tracking={"fit_depth": True})
    elif depth_noise_per_m is not None:
        gray = {"align_weight_color": max(config.tracking.align_weight_color, LEAST_GRAY)}
        times = {"calibrate": config.input.calibrate.replace("auto", "off")}  # depth is read with its colour
        config = config.changed(**_not_given({"tracking": gray, "input": times}, given))
    if depth_noise_per_m is None or "render.depth_noise_per_m" in given:
        return config
    return config.changed(render={"depth_noise_per_m": depth_noise_per_m})


def scaled(config: Config, factor: float, given: Collection[str] = ()) -> Config:
    """Return the settings for a scene `factor` times as large as a room: lengths and learning rates of lengths grow,
    weights of losses in metres shrink. With factor 1 the settings are unchanged, and those of `given` are always."""
    if factor == 1.0:
        return config
    sections = {
        section: {name: getattr(getattr(config, section), name) * factor**power for name, power in powers.items()}
        for section, powers in POWERS.items()
    }
    return config.changed(**_not_given(sections, given))


def _not_given(changes: Mapping[str, Mapping[str, object]], given: Collection[str]) -> dict[str, dict[str, Any]]:
    """Return the changes of settings by section, without those that are named in `given`."""
    return {
        section: {name: value for name, value in values.items() if f"{section}.{name}" not in given}
        for section, values in changes.items()
    }
