"""Splats are written by the standard deviation of their depth."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from sigmasplat.data.field import GaussianField
from sigmasplat.errors import RunError
from sigmasplat.plugins.outputs import chosen_splats
from sigmasplat.uncertainty.map_uncertainty import SplatStd


def three() -> GaussianField:
    """Return splats with opacities 0.9, 0.5, 0.1."""
    return GaussianField.from_values(
        torch.zeros(3, 3),
        torch.ones(3),
        torch.zeros(3, 3),
        opacities=torch.tensor([0.9, 0.5, 0.1]),
    )


STD = SplatStd(torch.tensor([0.03, 0.01, 0.02]), torch.zeros(3))


def written(std_below_m: float | None) -> list[float]:
    """Return the opacities of the splats that are written."""
    found: list[float] = []
    source = SimpleNamespace(path=Path("run"), splats=lambda: (three(), STD))

    def write(field: GaussianField, std: SplatStd | None) -> None:
        found.extend(field.opacities.tolist())

    chosen_splats.write_splats(source, "y-down", write, std_below_m, "camera")
    return [round(opacity, 3) for opacity in found]


def test_a_bound_of_the_depth_drops_exactly_the_splats_above_it() -> None:
    assert written(None) == [0.9, 0.5, 0.1] and written(0.03) == [0.5, 0.1] and written(0.015) == [0.5]
    with pytest.raises(RunError, match=r"no splat of run is left \(median depth_std_m is 0\.02 m\)"):
        written(0.01)
