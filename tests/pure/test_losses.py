"""Hold each loss term against values by hand or by scikit-image, and its gradient against what it may train."""

from typing import Any

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from sigmasplat.errors import ConfigError
from sigmasplat.fit import losses

H, W = 24, 31
IMAGE_TERMS = ("l1", "ssim", "depth", "nll_color", "nll_depth", "moment", "mean_depth")
RENDERED = ("color", "depth", "alpha", "variance", "moment")


def maps(seed: int = 0, valid: Tensor | None = None) -> dict[str, Tensor]:
    """Make float64 maps; rendered ones are leaves."""
    rng = np.random.default_rng(seed)

    def leaf(*shape: int) -> Tensor:
        return torch.tensor(rng.uniform(0.05, 1.0, shape), requires_grad=True)

    rendered = {"color": leaf(H, W, 3), "depth": leaf(H, W), "variance": leaf(H, W, 3), "moment": leaf(H, W)}
    rendered["alpha"] = torch.tensor(rng.uniform(0.6, 1.0, (H, W)), requires_grad=True)
    target = {"color_target": leaf(H, W, 3).detach(), "depth_target": leaf(H, W).detach(), "scales": leaf(7, 3)}
    rendered["covariance"] = six(rng.normal(size=(H, W, 3, 3))).requires_grad_()
    return rendered | target | {"valid": torch.ones(H, W, dtype=torch.bool) if valid is None else valid}


def six(factor: Any) -> Tensor:
    """Write 0.1 F Fᵀ + 0.05 I of F [..., 3, 3] as (rr, gg, bb, rg, rb, gb) [..., 6]."""
    V = torch.as_tensor(0.1 * factor @ np.swapaxes(factor, -1, -2) + 0.05 * np.eye(3))
    return torch.stack([V[..., i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], -1)


def half() -> Tensor:
    valid = torch.ones(H, W, dtype=torch.bool)
    valid[:, : W // 2] = False
    return valid


def test_means_are_over_valid_pixels_only() -> None:
    m, valid = maps(valid=half()), half()
    for name, a, b in (("l1", "color", "color_target"), ("depth", "depth", "depth_target")):
        expected = (m[a] - m[b]).abs().detach().numpy()[valid.numpy()].mean()
        assert losses.total({name: 1.0}, m).item() == pytest.approx(expected, rel=1e-12)
    assert losses.total({"moment": 1.0}, m).item() == pytest.approx(m["moment"][valid].mean().item(), rel=1e-12)


def test_depth_without_reading_is_masked_even_if_called_valid() -> None:
    m = maps()
    m["depth_target"][:5] = 0.0
    expected = (m["depth"] - m["depth_target"]).abs()[5:].mean().item()
    assert losses.total({"depth": 1.0}, m).item() == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", IMAGE_TERMS)
def test_invalid_pixels_reach_neither_value_nor_gradient(name: str) -> None:
    for poison in [float("nan"), float("inf"), 1e30]:
        clean, dirty = maps(valid=half()), maps(valid=half())
        with torch.no_grad():
            for key in (*RENDERED, "color_target", "depth_target"):
                dirty[key][:, : W // 2] = poison
        values = [losses.total({name: 1.0}, m) for m in (clean, dirty)]
        assert values[0].item() == values[1].item()
        values[0].backward()
        values[1].backward()
        for key in RENDERED:
            a, b = clean[key].grad, dirty[key].grad
            assert (a is None) == (b is None)
            if a is not None and b is not None:
                assert torch.equal(a, b) and torch.count_nonzero(b[:, : W // 2]) == 0


@pytest.mark.parametrize("name", IMAGE_TERMS)
def test_empty_mask_gives_zero_with_zero_gradient(name: str) -> None:
    m = maps(valid=torch.zeros(H, W, dtype=torch.bool))
    value = losses.total({name: 1.0}, m)
    value.backward()
    assert value.item() == pytest.approx(0.0, abs=1e-15)
    for key in RENDERED:
        assert m[key].grad is None or torch.count_nonzero(m[key].grad) == 0


def test_ssim_equals_scikit_image_away_from_the_border() -> None:
    m = maps()
    a, b = m["color"].detach(), (0.7 * m["color"] + 0.3 * m["color_target"]).detach()
    settings: dict[str, Any] = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    _, oracle = structural_similarity(a.numpy(), b.numpy(), channel_axis=2, data_range=1.0, full=True, **settings)
    np.testing.assert_allclose(losses.ssim_map(a, b)[5:-5, 5:-5], oracle[5:-5, 5:-5], atol=1e-10)


def test_ssim_pads_with_zeros_at_the_border() -> None:
    a, b = maps(1)["color"].detach(), maps(2)["color"].detach()
    wide_a, wide_b = (torch.nn.functional.pad(x, (0, 0, 8, 8, 8, 8)) for x in (a, b))
    torch.testing.assert_close(losses.ssim_map(a, b), losses.ssim_map(wide_a, wide_b)[8:-8, 8:-8])


def test_ssim_loss_is_zero_for_equal_images_and_sees_masked_ones() -> None:
    m = maps(valid=half())
    same = losses.ssim(m["color"], m["color"].detach(), m["valid"])
    assert same.item() == pytest.approx(0.0, abs=1e-12)
    a, b = (m[k].detach() * half()[..., None] for k in ("color", "color_target"))
    expected = 1 - losses.ssim_map(a, b).mean().item()
    assert losses.total({"ssim": 1.0}, m).item() == pytest.approx(expected, rel=1e-12)


def test_isotropy_is_zero_for_round_splats_and_known_for_others() -> None:
    assert losses.isotropy(torch.full((4, 3), 0.3)).item() == pytest.approx(0.0, abs=1e-7)
    assert losses.isotropy(torch.tensor([[1.0, 2.0, 6.0], [1.0, 1.0, 1.0]])).item() == pytest.approx((2 + 1 + 3) / 6)
    assert losses.isotropy(torch.zeros(0, 3)).item() == 0.0


def test_nll_is_the_gaussian_one_and_trains_variance_only() -> None:
    m = maps()
    value = losses.total({"nll_color": 1.0}, m)
    r, v = (m["color"] - m["color_target"]).detach(), m["variance"].detach() + losses.NLL_EPS
    normal = -torch.distributions.Normal(torch.zeros_like(r), v.sqrt()).log_prob(r).mean() - 0.5 * np.log(2 * np.pi)
    assert value.item() == pytest.approx(normal.item(), rel=1e-10)
    value.backward()
    assert m["color"].grad is None and m["variance"].grad is not None


def test_nll_is_least_where_variance_equals_squared_residual() -> None:
    m = maps()
    with torch.no_grad():
        m["variance"].copy_((m["depth"] - m["depth_target"])[..., None] ** 2 - losses.NLL_EPS)
        m["variance"].clamp_(min=1e-5)
    losses.total({"nll_depth": 1.0}, m).backward()
    settled = (m["depth"] - m["depth_target"])[..., None].expand(H, W, 3) ** 2 > 1e-4
    assert m["variance"].grad is not None
    assert float(m["variance"].grad[settled].abs().max()) < 1e-9


def test_nll_accepts_variance_slightly_below_zero() -> None:
    m = maps()
    with torch.no_grad():
        m["variance"][0, 0] = -1e-7
    before = m["variance"].detach().clone()
    value = losses.total({"nll_color": 1.0}, m)
    value.backward()
    assert torch.isfinite(value) and m["variance"].grad is not None and torch.isfinite(m["variance"].grad).all()
    assert torch.equal(m["variance"], before)


@pytest.mark.parametrize("name", IMAGE_TERMS)
def test_gradients_equal_finite_differences(name: str) -> None:
    m = maps(valid=half())
    trains = {
        "l1": "color",
        "ssim": "color",
        "depth": "depth",
        "mean_depth": "depth",
        "moment": "moment",
    }
    trained = trains.get(name, "variance")
    direction = torch.tensor(np.random.default_rng(1).normal(size=tuple(m[trained].shape)))
    losses.total({name: 1.0}, m).backward()
    gradient = m[trained].grad
    assert gradient is not None
    sides = [losses.total({name: 1.0}, m | {trained: m[trained].detach() + s * 1e-7 * direction}) for s in (1, -1)]
    slope = (sides[0] - sides[1]).item() / 2e-7
    assert (gradient * direction).sum().item() == pytest.approx(slope, rel=1e-5)


def test_total_weighs_terms_skips_zeros_and_refuses_unknown_names() -> None:
    m = maps()
    expected = 0.8 * losses.total({"l1": 1.0}, m) + 0.2 * losses.total({"ssim": 1.0}, m)
    assert losses.total({"l1": 0.8, "ssim": 0.2}, m).item() == pytest.approx(expected.item(), rel=1e-12)
    del m["moment"]
    assert losses.total({"l1": 1.0, "moment": 0.0}, m).item() > 0
    with pytest.raises(ConfigError, match="unknown loss term 'l2'"):
        losses.total({"l2": 1.0}, m)


def test_a_new_term_is_one_function(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(losses, "TERMS", dict(losses.TERMS))

    @losses.term
    def squared(color: Tensor, color_target: Tensor, valid: Tensor) -> Tensor:
        return losses.mean_over((color - color_target) ** 2, valid)

    m = maps()
    expected = ((m["color"] - m["color_target"]) ** 2).mean().item()
    assert losses.total({"squared": 2.0}, m).item() == pytest.approx(2 * expected)
