"""Presets of papers and released code that cut submaps: each runs whole on a few small frames, with few iterations."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sigmasplat.config import Config
from sigmasplat.config.find_preset import list_presets, preset, presets_by_scene
from sigmasplat.config.text import override
from sigmasplat.system.slam import Slam
from small_room import frames

NAMES = [name for name in presets_by_scene() if name.startswith("varsplat-")]
NAMES += [name for name in list_presets() if name.endswith("-scannetpp")]
FIRST = ("-room0", "-fr1-desk", "-scene0000", "-281bc17764", "-scannetpp")
"""Endings of one preset of each data set: not marked slow."""

SHORT = {
    "input.width": "48", "input.crop_px": "0", "mapping.every": "1", "mapping.first_iterations": "12",
    "mapping.iterations": "6", "tracking.iterations": "6", "submaps.frames": "2", "loops.min_interval": "1",
    "loops.near_m": "2", "registration.iterations": "3", "final.iterations": "6",
}  # fmt: skip


def short(name: str) -> Config:
    return override(preset(name), SHORT)


@pytest.mark.parametrize(
    "name", [name if name.endswith(FIRST) else pytest.param(name, marks=pytest.mark.slow) for name in NAMES]
)
def test_a_preset_of_varsplat_maps_cuts_and_refines(name: str) -> None:
    slam = Slam(short(name))
    steps = [slam.step(frame) for frame in frames(5)]
    slam.finish()
    assert len(slam.store) >= 2 and len(slam.field) > 50
    assert bool(slam.field.params.isfinite().all())
    assert all(math.isfinite(step.T_world_camera.sum()) for step in steps)


@pytest.mark.parametrize("corrected", [False, True])
def test_a_darker_frame_is_mapped_in_the_exposure_of_the_map(corrected: bool) -> None:
    """A frame of which everything is 0.6 times as bright: the picture of its keyframe is as bright as the others."""
    bright = frames(3)
    dark = replace(bright[2], color=bright[2].color * np.float32(0.6))
    settings = {"tracking.iterations": "60", "mapping.first_iterations": "60", "submaps.frames": "0"}
    config = override(short("varsplat-released-scene0000"), settings | {"input.width": "96"})
    slam = Slam(replace(config, mapping=replace(config.mapping, colors="code" if corrected else "old-frozen")))
    for frame in (*bright[:2], dark):
        slam.step(frame)
    assert slam.keyframe_indices == [0, 1, 2]
    brightness = [float(keyframe.target.image.mean()) for keyframe in slam.mapper.keyframes]
    ratio = brightness[2] / brightness[1]
    assert 0.85 < ratio < 1.15 if corrected else ratio < 0.7
