"""benchmarks/full_resolution.py: what it enlarges, and its table."""

import importlib
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmark_results import laid_out
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.errors import SigmaSplatError
from sigmasplat.render import render

full_resolution = importlib.import_module("full_resolution")
CONFIG = override(preset("sigma"), {"input.width": "32", "backend": "reference"})
LARGE = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def wall() -> GaussianField:
    """Return two large splats side by side, a dark and a bright one."""
    means = torch.tensor([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]])
    return GaussianField.from_values(
        means, torch.full((2, 3), 0.3), torch.tensor([[0.1] * 3, [0.9] * 3]), opacities=0.9
    )


def test_a_large_image_is_the_small_one_enlarged() -> None:
    enlarged, T = full_resolution.Enlarged(CONFIG), np.eye(4)
    small, large = LARGE.prepared(32), enlarged(wall(), LARGE, T)
    kept = enlarged(wall(), small, T)
    assert torch.equal(kept.color, render(wall(), small, T, None, CONFIG.render, "reference").color)
    assert large.color.shape == (48, 64, 3) and large.alpha.shape == (48, 64)
    means = large.color.reshape(24, 2, 32, 2, 3).mean((1, 3))
    assert float((means - kept.color).abs().max()) < 0.02


def test_the_table_has_a_row_per_sequence() -> None:
    run = {"source": "room", "seed": 0} | {name: 30.0 + k for k, name in enumerate(full_resolution.COLUMNS)}
    other = run | {"seed": 1, "after": 39.0}
    made = laid_out("full_resolution", {"runs": [run, other, run | {"source": "hall"}]})["The camera's size"]
    assert [row[0] for row in made.rows] == ["room", "hall"]
    assert made.rows[0][8] == "38.0 ± 1.4" and made.columns[8] == "after"


@pytest.mark.parametrize(
    ("source", "problem"), [("no-such-folder", "no-such-folder"), ("synthetic:frames=3", "wider than 320 pixels")]
)
def test_what_cannot_be_measured_is_refused(tmp_path: Path, source: str, problem: str) -> None:
    options = full_resolution.Options((source,), (0,), runs=tmp_path / "runs")
    with pytest.raises(SigmaSplatError, match=problem):
        full_resolution.measure(options)
    assert not (tmp_path / "runs").exists()
