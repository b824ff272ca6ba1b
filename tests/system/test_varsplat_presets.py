"""Presets of papers and released code that cut submaps: each runs whole on a few small frames, with few iterations."""

import math

import pytest

from sigmasplat.config import Config
from sigmasplat.config.text import override
from sigmasplat.presets import list_presets, preset
from sigmasplat.slam.slam import Slam
from small_room import frames

NAMES = [name for name in list_presets() if name.startswith("varsplat-released-") or name.endswith("-scannetpp")]
SHORT = {
    "input.width": "48", "input.crop_px": "0", "mapping.every": "1", "mapping.first_iterations": "12",
    "mapping.iterations": "6", "tracking.iterations": "6", "submaps.frames": "2", "loops.min_interval": "1",
    "loops.near_m": "2", "registration.iterations": "3", "final.iterations": "6", "final.sh_every": "2",
    "final.spacing_m": "0.1",
}  # fmt: skip


def short(name: str) -> Config:
    return override(preset(name), SHORT)


@pytest.mark.parametrize("name", NAMES)
def test_a_preset_of_varsplat_maps_cuts_and_refines(name: str) -> None:
    slam = Slam(short(name))
    steps = [slam.step(frame) for frame in frames(5)]
    slam.finish()
    assert len(slam.store) >= 2 and len(slam.field) > 50
    assert bool(slam.field.params.isfinite().all())
    assert all(math.isfinite(step.T_world_camera.sum()) for step in steps)
