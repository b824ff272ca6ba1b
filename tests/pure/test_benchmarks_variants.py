"""benchmarks/variants.py: variants lie within their recording, their camera fits their images, worse is marked."""

import importlib
from typing import Any

import numpy as np
import pytest

from benchmark_results import laid_out
from sigmasplat.data.camera import Camera

variants: Any = importlib.import_module("variants")
recordings: Any = importlib.import_module("disturbed_recordings")
CAMERA = Camera(64, 48, 50.0, 51.0, 30.5, 22.5)


def recording(frames: int) -> Any:
    """Return frames with a bright square around the pixel (40, 20), of another brightness in each frame."""
    color = np.zeros((frames, 48, 64, 3), np.uint8)
    color[:, 16:24, 36:44] = 10 * np.arange(1, frames + 1)[:, None, None, None]
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = np.arange(frames)
    depth = np.full((frames, 48, 64), 5000, np.uint16)
    return recordings.Original("desk", CAMERA, color, depth, np.arange(frames), poses)


@pytest.mark.parametrize("available", [5, 40, 151, 400])
def test_a_seed_draws_frames_that_the_recording_has(available: int) -> None:
    made = [variants.drawn("desk", available, np.random.default_rng(seed)) for seed in range(60)]
    assert made == [variants.drawn("desk", available, np.random.default_rng(seed)) for seed in range(60)]
    assert len({variant.frames for variant in made}) > 1
    for variant in made:
        assert min(available, variants.FEWEST) <= len(variant.frames) <= variants.MOST
        assert min(variant.frames) >= 0 and max(variant.frames) < available
        assert len({*np.diff(variant.frames)}) == 1


@pytest.mark.parametrize(("size", "shape"), [("whole", (48, 64)), ("middle", (24, 32)), ("quarter", (12, 16))])
def test_a_point_stays_where_it_is_in_the_world(size: str, shape: tuple[int, int]) -> None:
    shown = variants.resized(recording(6), (4, 2, 0), size)
    c = shown.camera
    assert (c.height, c.width) == shape == shown.color.shape[1:3] == shown.depth.shape[1:]
    assert [shown.color[i].max() for i in range(3)] == [50, 30, 10]
    assert shown.T_world_camera[:, 0, 3].tolist() == [4.0, 2.0, 0.0]
    v, u = (float(np.mean(where)) for where in np.nonzero(shown.color[0, ..., 0]))
    assert (u - c.cx) / c.fx == pytest.approx((39.5 - CAMERA.cx) / CAMERA.fx, abs=1e-6)
    assert (v - c.cy) / c.fy == pytest.approx((19.5 - CAMERA.cy) / CAMERA.fy, abs=1e-6)


def test_rows_that_are_worse_than_the_plain_system_are_marked() -> None:
    variant = variants.Variant("desk", (8, 6, 4), "middle", "blur", 2).words
    row = {"variant": variant, "problem": None, "frames": 3, "lost": 0, "silent": 0}
    figures = [(0.02, 0.01), (0.02, 0.0199), (0.001, 0.0007), (0.00085, 0.0007), (0.02, None), (None, 0.01)]
    rows = [row | {"ate_m": ate_m, "plain_ate_m": plain_m} for ate_m, plain_m in figures]
    measured = {"rows": [*rows, row | {"problem": "gone"}]}
    both = laid_out("variants", measured)
    made = both["Variants"]
    assert made.rows[0][:4] == ["desk", "8 … 4 by 2", "middle", "motion blur 15 px"]
    assert [cells[4] for cells in made.rows] == ["2.00 (worse)", "2.00", "0.100 (worse)", "0.0850", "2.00", "– (worse)"]
    assert [cells[5] for cells in made.rows] == ["1.00", "1.99", "0.0700", "0.0700", "diverged", "1.00"]
    assert both["By recording"].rows == [[name, "6", "3", "1.37", "0", "0"] for name in ("desk", "all")]
