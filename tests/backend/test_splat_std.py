"""Standard deviations of splats: the variance that the map predicts for the pixels that show a splat."""

import numpy as np
import pytest
import torch

from paper_settings import RenderConfig
from sigmasplat.data.field import GaussianField
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.uncertainty.calibration import splat_std
from sigmasplat.uncertainty.map_uncertainty import COLOR_PARTS, DEPTH_PARTS, Background, Calibration, MapUncertainty
from sigmasplat.uncertainty.predictive import predict
from splat_scenes import WIDE

OPTIONS = RenderConfig()
BACKGROUND = Background((0.5, 0.5, 0.5), 0.04, 0.25)
ONLY_RESIDUAL = Calibration(
    dict.fromkeys(COLOR_PARTS, 0.0) | {"residual": 1.0}, dict.fromkeys(DEPTH_PARTS, 0.0) | {"residual": 1.0}
)


def keyframe() -> Keyframe:
    size = WIDE.height, WIDE.width
    return Keyframe(0, Target(WIDE, torch.full((3, *size), 0.5), torch.full(size, 2.0), size[0] * size[1]), np.eye(4))


KEYFRAMES = [keyframe()] * 10


def wall() -> tuple[GaussianField, torch.Tensor]:
    """Return a gray, opaque wall at 2 m with a splat in each pixel, and the column [N] of each splat."""
    rows = torch.arange(WIDE.height * WIDE.width)
    at = torch.stack([rows % WIDE.width, rows // WIDE.width], 1).float()
    sides = (at - torch.tensor([WIDE.cx, WIDE.cy])) / torch.tensor([WIDE.fx, WIDE.fy]) * 2.0
    means = torch.cat([sides, torch.full_like(at[:, :1], 2.0)], 1)
    return GaussianField.from_values(means, torch.full_like(means, 0.03), torch.full_like(means, 0.5)), at[:, 0]


def test_each_part_of_a_surface_has_its_own_standard_deviation() -> None:
    """1 cm and 0.02 in the left half of a wall, 4 cm and 0.1 in the right half."""
    field, column = wall()
    left = torch.tensor([0.02**2, 9.0, 0.01**2])  # the second column is about readings of the sensor
    right = torch.tensor([0.1**2, 9.0, 0.04**2])
    values = torch.where((column < 22)[:, None], left, right)
    std = splat_std(field, MapUncertainty(values, BACKGROUND, ONLY_RESIDUAL), KEYFRAMES, OPTIONS, "cpu")
    for inside, depth_m, color in ((column < 15, 0.01, 0.02), (column > 29, 0.04, 0.1)):
        assert float(std.depth_std_m[inside].median()) == pytest.approx(depth_m, rel=0.1)
        assert float(std.color_std[inside].median()) == pytest.approx(color, rel=0.1)


def test_a_splat_that_no_keyframe_shows_has_the_standard_deviation_of_the_background() -> None:
    field, _ = wall()
    behind = GaussianField.from_values(torch.tensor([[0.0, 0.0, -3.0]]), torch.ones(1), torch.ones(1, 3))
    n = len(field)
    field.append(behind)
    values = torch.full((n + 1, 3), 1e-4)
    std = splat_std(field, MapUncertainty(values, BACKGROUND, ONLY_RESIDUAL), KEYFRAMES, OPTIONS, "cpu")
    assert float(std.depth_std_m[n]) == pytest.approx(0.5)
    assert float(std.color_std[n]) == pytest.approx(0.2)


def test_a_few_pixels_of_large_variance_do_not_decide() -> None:
    """A splat at the edge of the wall: beside it nothing is known."""
    field, column = wall()
    field.keep(column < 30)
    values = torch.full((len(field), 3), 1e-4)
    weights = Calibration(ONLY_RESIDUAL.color, dict(ONLY_RESIDUAL.depth) | {"edges": 1e-5})
    std = splat_std(field, MapUncertainty(values, BACKGROUND, weights), KEYFRAMES, OPTIONS, "cpu")
    seen = predict(field, MapUncertainty(values, BACKGROUND, weights), WIDE, np.eye(4), OPTIONS, "cpu")
    assert float(seen.depth_std_m.max()) > 0.1
    assert float(std.depth_std_m.median()) == pytest.approx(0.01, rel=0.1)
    assert float(std.depth_std_m.quantile(0.99)) < 0.1


def test_a_pixel_that_one_splat_covers_alone_has_the_standard_deviation_of_the_splat(kernels: str) -> None:
    field = GaussianField.from_values(
        torch.tensor([[0.0, 0.0, 2.0]]),
        torch.tensor([5.0]),
        torch.tensor([[0.2, 0.5, 0.7]]),
        opacities=torch.tensor([0.999]),
        log_variances=torch.tensor([[0.01, 0.02, 0.06]]).log(),
    )
    color = dict.fromkeys(COLOR_PARTS, 0.0) | {"mixture": 0.5, "residual": 0.9, "floor": 1e-4}
    depth = dict.fromkeys(DEPTH_PARTS, 1.0) | {"unexplained": 0.0, "residual": 0.25, "floor": 1e-6}
    values = torch.tensor([[0.004, 0.0009, 0.0004]])
    uncertainty = MapUncertainty(values, BACKGROUND, Calibration(color, depth))
    std = splat_std(field, uncertainty, [keyframe()], OPTIONS, kernels)
    seen = predict(field, uncertainty, WIDE, np.eye(4), OPTIONS, kernels)
    row, column = WIDE.height // 2, WIDE.width // 2
    assert float(std.depth_std_m[0]) == pytest.approx((0.25 * 0.0004 + 1e-6) ** 0.5, rel=0.03)
    assert float(seen.depth_std_m[row, column]) == pytest.approx(float(std.depth_std_m[0]), rel=0.03)
    assert float(seen.color[row, column].sqrt()) == pytest.approx(float(std.color_std[0]), rel=0.03)
