"""A map that was refined on large images has a smaller low-pass in small ones."""

import numpy as np
import pytest
import torch

from constants import changed
from paper_settings import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.render import FieldRenderer, render
from sigmasplat.render.render import as_refined

SMALL = Camera(32, 24, 30.0, 30.0, 16.0, 12.0)
OPTIONS = RenderConfig()


def dots(distance_m: float = 2.0) -> GaussianField:
    """Return splats far smaller than a pixel, one metre apart in depth at most."""
    random = np.random.default_rng(3)
    means = torch.from_numpy(random.uniform([-0.8, -0.6, 0.0], [0.8, 0.6, 1.0], (60, 3))).float()
    means[:, 2] += distance_m
    return GaussianField.from_values(means, torch.full((60, 3), 1e-3), torch.from_numpy(random.random((60, 3))).float())


def test_the_low_pass_keeps_its_size_on_the_scene() -> None:
    assert as_refined(OPTIONS, SMALL, 60.0).low_pass_px2 == pytest.approx(OPTIONS.low_pass_px2 / 4.0)
    assert vars(as_refined(OPTIONS, SMALL, 60.0)) == vars(OPTIONS) | {"low_pass_px2": OPTIONS.low_pass_px2 / 4.0}


@pytest.mark.parametrize("fx", [None, 30.0, 15.0])
def test_images_at_least_as_large_keep_theirs(fx: float | None) -> None:
    assert as_refined(OPTIONS, SMALL, fx) == OPTIONS


def test_only_the_refined_field_changes() -> None:
    refined, other = dots(), dots()
    renderer, T = FieldRenderer(OPTIONS, "reference", (refined, 60.0)), np.eye(4)
    sharper = render(other, SMALL, T, None, changed(OPTIONS, low_pass_px2=OPTIONS.low_pass_px2 / 4.0), "reference")
    usual = render(other, SMALL, T, None, OPTIONS, "reference")
    assert torch.equal(renderer(refined, SMALL, T).color, sharper.color)
    assert torch.equal(renderer(other, SMALL, T).color, usual.color)


def test_tiny_splats_cover_the_same_share_of_both_images() -> None:
    """With one low-pass for both sizes, a dot covers four times as many pixels of the large image, not as many."""
    large, field, T = Camera(64, 48, 60.0, 60.0, 32.0, 24.0), dots(), np.eye(4)
    renderer = FieldRenderer(OPTIONS, "reference", (field, 60.0))
    share, small_share = (float(renderer(field, camera, T).alpha.mean()) for camera in (large, SMALL))
    plain = float(render(field, SMALL, T, None, OPTIONS, "reference").alpha.mean())
    assert small_share == pytest.approx(share, rel=0.15)
    assert plain > 1.5 * share
