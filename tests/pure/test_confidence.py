"""Hold tracking's weights and masks against VarSplat §3 written out, and their edges against reason."""

import numpy as np
import pytest
import torch

from sigmasplat.fit.tracking_loss import outlier_mask, uncertainty_weights

H, W = 13, 17


def variance(seed: int = 0) -> torch.Tensor:
    return torch.tensor(np.exp(np.random.default_rng(seed).normal(-5, 3, (H, W, 3))), requires_grad=True)


def mask(seed: int = 0) -> torch.Tensor:
    """Choose an odd number of pixels, so that the median is one of them."""
    chosen = np.random.default_rng(seed).permutation(H * W)[:101]
    flat = torch.zeros(H * W, dtype=torch.bool)
    flat[torch.as_tensor(chosen)] = True
    return flat.reshape(H, W)


def test_weights_equal_the_formula() -> None:
    v, m = variance(), mask()
    log = np.log(v.detach().numpy() + 1e-6)
    expected = np.exp(-(log - np.median(log[m.numpy()], axis=0)) / 10.0)
    np.testing.assert_allclose(uncertainty_weights(v, m, 10.0, 3.0), np.clip(expected, 1 / 3, 3), rtol=1e-12)
    sharp = uncertainty_weights(v, m, 1.0, 3.0)
    assert float(sharp.min()) == pytest.approx(1 / 3) and float(sharp.max()) == pytest.approx(3.0)


def test_weights_carry_no_gradient_and_fall_with_variance() -> None:
    v = variance()
    w = uncertainty_weights(v, mask(), 5.0, 100.0)
    assert not w.requires_grad
    order = v.detach()[..., 0].flatten().argsort()
    assert bool((w[..., 0].flatten()[order].diff() <= 0).all())


def test_weights_do_not_know_the_unit_of_variance() -> None:
    v, m = variance().detach(), mask()
    torch.testing.assert_close(
        uncertainty_weights(v, m, 10.0, 3.0, eps=1e-12), uncertainty_weights(1000 * v, m, 10.0, 3.0, eps=1e-9)
    )


def test_each_channel_has_its_own_median_over_the_mask_alone() -> None:
    v, m = variance().detach(), mask()
    w = uncertainty_weights(v, m, 10.0, 3.0)
    louder = v.clone()
    louder[~m] *= 50
    louder[..., 2] *= 9
    other = uncertainty_weights(louder, m, 10.0, 3.0, eps=1e-6)
    torch.testing.assert_close(other[m][:, :2], w[m][:, :2], rtol=0, atol=0)
    np.testing.assert_allclose(np.median(w[m], axis=0), 1.0, rtol=1e-12)


def test_weights_bear_rounding_below_zero_even_variance_and_an_empty_mask() -> None:
    v = variance().detach()
    v[0, 0] = -1e-7
    assert torch.isfinite(uncertainty_weights(v, mask(), 10.0, 3.0)).all()
    assert torch.equal(uncertainty_weights(torch.full((H, W, 3), 0.2), mask(), 10.0, 3.0), torch.ones(H, W, 3))
    assert torch.equal(uncertainty_weights(v, torch.zeros(H, W, dtype=torch.bool), 10.0, 3.0), torch.ones_like(v))


def test_outliers_are_beyond_the_factor_times_the_median_of_valid_errors() -> None:
    error = torch.tensor([[0.01, -0.02, 0.03, -0.9, 5.0]])
    valid = torch.tensor([[True, True, True, True, False]])
    assert outlier_mask(error, valid, 10.0).tolist() == [[True, True, True, False, False]]
    assert outlier_mask(error, valid, 100.0).tolist() == [[True, True, True, True, False]]
    assert outlier_mask(error, valid, 0.0).tolist() == valid.tolist()


def test_outlier_mask_accepts_perfect_depth_nan_and_zero_valid_pixels() -> None:
    valid = torch.ones(1, 4, dtype=torch.bool)
    assert outlier_mask(torch.tensor([[0.0, 0.0, 0.0, 0.1]]), valid, 50.0).tolist() == [[True, True, True, False]]
    nan = torch.tensor([[0.1, 0.2, float("nan"), 0.1]])
    assert outlier_mask(nan, valid, 50.0).tolist() == [[True, True, False, True]]
    assert not outlier_mask(nan, ~valid, 50.0).any()
