"""Open a sequence together with the settings that belong to its scene: every run gets both from here."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from sigmasplat.config import Config
from sigmasplat.config.scale import for_scene
from sigmasplat.input.opening import open_source
from sigmasplat.input.source import Source
from sigmasplat.run.pose_scale import with_measured_scale


def open_scene(path: str | Path, config: Config | None = None, given: Collection[str] = ()) -> tuple[Source, Config]:
    """Open a sequence; return it with the settings for its scene, which differ from `config` outdoors and for stereo.

    given: names of settings that keep their values, as in ["input.max_depth_m"]. With known poses, an
    `input.poses_scale` of 0 is measured, or the scale of predicted depth. Raises as `open_source`.
    """
    config = config or Config()
    source, asked = open_source(path, config.input), config.input
    if asked.poses and not (asked.poses_scale and (asked.predicted_scale or not source.predicted_depth)):
        config = with_measured_scale(source, config)
    if config.input != asked:
        source = open_source(path, config.input)
    return source, config_for(source, config, given)


def config_for(source: Source, config: Config, given: Collection[str] = ()) -> Config:
    """Return the settings for the scene of a source; those named in `given` keep their values."""
    return for_scene(config, source.scene_scale, source.depth_noise_per_m, given, source.sensor, source.predicted_depth)


def scene_facts(source: Source) -> dict[str, Any]:
    """Return what run.json keeps of the scene: its size, the noise of depth, the sensor, and if a network
    predicted depth this fact."""
    facts: dict[str, Any] = {
        "scene_scale": source.scene_scale, "depth_noise_per_m": source.depth_noise_per_m, "sensor": source.sensor
    }  # fmt: skip
    return facts | ({"predicted_depth": True} if source.predicted_depth else {})


def config_of_facts(facts: Mapping[str, Any], config: Config, given: Collection[str] = ()) -> Config:
    """Return the settings that a run with these facts (run.json) used if it was asked for `config`."""
    noise, predicted = facts.get("depth_noise_per_m"), bool(facts.get("predicted_depth"))
    return for_scene(config, facts.get("scene_scale") or 1.0, noise, given, facts.get("sensor"), predicted)
