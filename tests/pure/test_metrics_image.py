"""PSNR, SSIM, MS-SSIM and depth L1 against scikit-image, pytorch-msssim and values known by hand."""

import numpy as np
import pytest
import pytorch_msssim
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.evaluation.metrics.image import depth_l1, ms_ssim, psnr, similarity_factors, ssim


def pair(seed: int, height: int = 37, width: int = 52) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / 11.0
    clean = np.stack([np.sin(x), np.cos(y), np.sin(x * y)], -1) * 0.4 + 0.5
    return clean.astype(np.float32), np.clip(clean + rng.normal(0, 0.07, clean.shape), 0, 1).astype(np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_ssim_equals_scikit_image(seed: int) -> None:
    a, b = pair(seed)
    expected = structural_similarity(
        a.astype(float), b.astype(float), channel_axis=-1, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, data_range=1.0,
    )  # fmt: skip
    assert ssim(a, b) == pytest.approx(expected, abs=1e-10)


def test_psnr_equals_scikit_image_and_the_formula() -> None:
    a, b = pair(0)
    expected = peak_signal_noise_ratio(a.astype(float), b.astype(float), data_range=1.0)
    assert psnr(a, b) == pytest.approx(expected, abs=1e-9)
    assert psnr(np.full((4, 4, 3), 0.6), np.full((4, 4, 3), 0.5)) == pytest.approx(20.0)


def test_masked_pixels_do_not_count() -> None:
    a, b = pair(1)
    valid = np.zeros(a.shape[:2], bool)
    valid[8:30, 10:40] = True
    spoilt = b.copy()
    spoilt[~valid] = 0.0
    assert psnr(a, spoilt, valid) == psnr(a, b, valid) > psnr(a, spoilt)
    inner = np.zeros_like(valid)
    inner[13:25, 15:35] = True
    assert ssim(a, spoilt, inner) == pytest.approx(ssim(a, b, inner), abs=1e-12)
    luminance, contrast = similarity_factors(a, b)
    assert ssim(a, b, inner) == pytest.approx((luminance * contrast)[8:20, 10:30].mean())


def test_scores_of_equal_images_and_of_no_pixels() -> None:
    a, _ = pair(2)
    assert ssim(a, a) == pytest.approx(1.0)
    assert psnr(a, a) == np.inf
    nothing = np.zeros(a.shape[:2], bool)
    assert np.isnan(psnr(a, a, nothing)) and np.isnan(ssim(a, a, nothing))
    with pytest.raises(SigmaSplatError, match="11×11 pixels, found 52×10"):
        ssim(a[:10], a[:10])


def test_depth_l1_uses_pixels_with_both_readings() -> None:
    measured = np.array([[1.0, 0.0, 2.0, 3.0]], np.float32)
    rendered = np.array([[1.1, 5.0, 0.0, 2.7]], np.float32)
    assert depth_l1(rendered, measured) == pytest.approx(0.2, abs=1e-6)
    assert depth_l1(rendered, measured, np.array([[True, True, True, False]])) == pytest.approx(0.1, abs=1e-6)
    assert np.isnan(depth_l1(rendered, np.zeros_like(measured)))


@pytest.mark.parametrize("size", [(161, 200), (163, 175), (240, 321), (176, 176)])
def test_ms_ssim_equals_pytorch_msssim(size: tuple[int, int]) -> None:
    a, b = pair(size[0], *size)
    nchw = [torch.from_numpy(image).double().permute(2, 0, 1)[None] for image in (a, b)]
    assert ms_ssim(a, b) == pytest.approx(pytorch_msssim.ms_ssim(*nchw, data_range=1.0).item(), abs=1e-6)
    factors = similarity_factors(a, b)
    assert ms_ssim(a, b, factors) == ms_ssim(a, b) and ssim(a, b, None, factors) == ssim(a, b)
    assert ms_ssim(a, b) < 0.99 and ms_ssim(a, a) == pytest.approx(1.0)


def test_ms_ssim_of_a_negative_counts_as_zero() -> None:
    a, _ = pair(4, 170, 180)
    nchw = [torch.from_numpy(image).double().permute(2, 0, 1)[None] for image in (a, 1 - a)]
    assert ms_ssim(a, 1 - a) == pytorch_msssim.ms_ssim(*nchw, data_range=1.0).item() == 0.0


def test_ms_ssim_needs_161_pixels_in_each_direction() -> None:
    a, b = pair(0, 160, 400)
    assert np.isnan(ms_ssim(a, b)) and np.isnan(ms_ssim(a.swapaxes(0, 1), b.swapaxes(0, 1)))
