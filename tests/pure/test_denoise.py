"""Smoothing of noisy depth images: clean ones are unchanged, steps stay sharp, holes stay holes."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sigmasplat.fit.compare import noise_scale
from sigmasplat.tracking.depth_filters import denoised

Depth = NDArray[np.float32]


def room(noise: float, step_m: float = 1.5, seed: int = 0) -> tuple[Depth, Depth]:
    """Return a sloped wall with a box in front of it, 120 × 160, without and with noise of `noise` z² m."""
    v, u = np.mgrid[0:120, 0:160]
    exact = (2.5 + 0.004 * u + 0.002 * v).astype(np.float32)
    exact[40:80, 50:100] -= np.float32(step_m)
    read = exact + noise * exact**2 * np.random.default_rng(seed).standard_normal(exact.shape)
    return exact, read.astype(np.float32)


@pytest.mark.parametrize("noise", [0.0, 0.001])
def test_depth_of_a_good_sensor_is_not_touched(noise: float) -> None:
    _, read = room(noise)
    assert denoised(read) is read


@pytest.mark.parametrize("noise", [0.01, 0.02])
def test_noise_falls_to_less_than_half_and_steps_stay_sharp(noise: float) -> None:
    exact, read = room(noise)
    smooth = denoised(read)
    before, after = (np.abs(image - exact) / exact**2 for image in (read, smooth))
    edge = np.zeros(exact.shape, bool)
    edge[36:84, 46:104] = True
    edge[44:76, 54:96] = False
    for part in (edge, ~edge):
        assert np.sqrt(np.mean(after[part] ** 2)) < 0.5 * np.sqrt(np.mean(before[part] ** 2))
    assert noise_scale(smooth) < 0.5 * noise_scale(read)
    assert abs(float(np.mean((smooth - exact) / exact))) < 0.005, "no bias"


def test_holes_stay_holes_and_do_not_change_their_neighbours() -> None:
    exact, read = room(0.02)
    holes = np.random.default_rng(1).random(read.shape) < 0.5
    pierced = np.where(holes, np.float32(0), read)
    smooth = denoised(pierced)
    assert ((smooth > 0) == (pierced > 0)).all()
    kept = ~holes
    error = np.abs(smooth[kept] - exact[kept]) / exact[kept] ** 2
    assert np.sqrt(np.mean(error**2)) < 0.65 * 0.02


def test_an_image_without_readings_is_unchanged() -> None:
    nothing = np.zeros((120, 160), np.float32)
    assert (denoised(nothing) == 0).all()
