"""Presets of papers and released code that cut submaps: each runs whole on a few small frames, with few iterations."""

import math

import numpy as np
import pytest

from sigmasplat.config import Config
from sigmasplat.config.text import override
from sigmasplat.model import se3
from sigmasplat.presets import list_presets, preset
from sigmasplat.slam.slam import Slam
from small_room import frames

NAMES = [name for name in list_presets() if name.startswith("varsplat-released-") or name.endswith("-scannetpp")]
SHORT = {
    "input.width": "64", "input.crop_px": "0", "mapping.every": "2", "mapping.first_iterations": "12",
    "mapping.iterations": "6", "tracking.iterations": "6", "submaps.frames": "3", "loops.min_interval": "1",
    "loops.near_m": "2", "registration.iterations": "3", "final.iterations": "6", "final.sh_every": "2",
    "final.spacing_m": "0.1",
}  # fmt: skip


def short(name: str) -> Config:
    return override(preset(name), SHORT)


@pytest.mark.parametrize("name", NAMES)
def test_a_preset_of_varsplat_maps_cuts_and_refines(name: str) -> None:
    slam = Slam(short(name))
    steps = [slam.step(frame) for frame in frames(7)]
    slam.finish()
    assert len(slam.store) >= 2 and len(slam.field) > 100
    assert bool(slam.field.params.isfinite().all())
    assert all(math.isfinite(step.T_world_camera.sum()) for step in steps)


def test_submaps_are_registered_by_the_images_they_render() -> None:
    """ScanNet's preset as released: with a loop between submaps that overlap, the anchors stay where they are."""
    config = override(short("varsplat-released-scene0000"), {"input.width": "96", "registration.iterations": "10"})
    config = override(config, {"mapping.first_iterations": "60", "mapping.iterations": "30"})
    slam = Slam(config)
    for frame in frames(10):
        slam.step(frame)
    slam.finish()
    assert slam.closer.loops and any(loop.localised for loop in slam.closer.loops)
    for loop in slam.closer.loops:
        if loop.accepted:
            assert loop.translation_m < 0.1 and loop.rotation_deg < 5.0
    assert np.allclose(slam.atlas.anchors[0], np.eye(4)) and se3.rotation_angle(slam.atlas.anchors[-1][:3, :3]) < 1.0
