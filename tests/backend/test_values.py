"""Known values a hand can check: one pixel, one-hot features, so that the sums are the weights themselves."""

from typing import Any

import pytest
import torch

from paper_settings import RenderConfig
from sigmasplat.data.camera import Camera

PIXEL = Camera(1, 1, 10.0, 10.0, 0.0, 0.0)
OPTIONS = RenderConfig()


def stack(backend: Any, alphas: list[float], z: list[float], offset_px: float = 0.0, ref: float = 0.0) -> Any:
    """Blend isotropic splats of 1 px in front of one pixel; opacities are leaves, features one-hot."""
    n = len(alphas)
    opacities = torch.tensor(alphas, requires_grad=True)
    means2d = torch.tensor([[offset_px, 0.0]]).repeat(n, 1)
    conics, radii = torch.tensor([[1.0, 0.0, 1.0]]).repeat(n, 1), torch.ones(n, 2)
    b = backend.blend(
        means2d, conics, torch.tensor(z), radii, opacities, torch.eye(n), torch.full((1, 1), ref), PIXEL, OPTIONS
    )
    return b, opacities


def test_weights_are_alpha_times_light_left(backend: Any) -> None:
    b, _ = stack(backend, [0.5, 0.4, 0.8], [3.0, 1.0, 2.0])
    assert b.sums[0, 0].tolist() == pytest.approx([0.5 * 0.6 * 0.2, 0.4, 0.8 * 0.6], rel=1e-5)
    assert float(b.alpha.detach()) == pytest.approx(1 - 0.6 * 0.2 * 0.5, rel=1e-5)
    assert (int(b.median_id), int(b.dominant_id)) == (2, 2)
    assert float(b.median_weight) == pytest.approx(0.48, rel=1e-5)


def test_moment_is_about_the_sensor_depth_and_zero_without_reading(backend: Any) -> None:
    b, _ = stack(backend, [0.5, 0.5], [2.0, 3.0], ref=2.5)
    assert float(b.moment.detach()) == pytest.approx(0.5 * 0.25 + 0.25 * 0.25, rel=1e-5)
    assert float(stack(backend, [0.5, 0.5], [2.0, 3.0], ref=0.0)[0].moment.detach()) == 0.0


def test_equal_depths_go_by_index(backend: Any) -> None:
    b, _ = stack(backend, [0.5, 0.6, 0.25], [1.0, 1.0, 1.0])
    assert b.sums[0, 0].tolist() == pytest.approx([0.5, 0.3, 0.05], rel=1e-5)
    b, _ = stack(backend, [0.5, 0.6, 0.25], [1.0, 0.5, 0.5])
    assert b.sums[0, 0].tolist() == pytest.approx([0.15, 0.6, 0.1], rel=1e-5)


def test_dominant_is_the_largest_weight_not_the_nearest_or_most_opaque(backend: Any) -> None:
    b, _ = stack(backend, [0.3, 0.5, 0.9], [1.0, 2.0, 3.0])
    assert b.sums[0, 0].tolist() == pytest.approx([0.3, 0.35, 0.315], rel=1e-5)
    assert int(b.dominant_id) == 1 and int(b.median_id) == 1


def test_a_pair_counts_while_light_before_it_reaches_the_stop(backend: Any) -> None:
    # Light before each: 1, .05, 2.5e-3, 1.25e-4 (counts, ≥ 1e-4), 6.25e-6 (does not).
    b, opacities = stack(backend, [0.95] * 6, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    assert b.sums[0, 0].tolist() == pytest.approx([0.95, 0.0475, 2.375e-3, 1.1875e-4, 0.0, 0.0], rel=1e-4)
    b.alpha.sum().backward()
    assert opacities.grad is not None and opacities.grad[4:].tolist() == [0.0, 0.0]
    assert opacities.grad[3] > 0


def test_opacity_is_clamped_at_99_percent_without_gradient(backend: Any) -> None:
    b, opacities = stack(backend, [0.999, 0.5], [1.0, 2.0])
    assert b.sums[0, 0].tolist() == pytest.approx([0.99, 0.005], rel=1e-4)
    b.alpha.sum().backward()
    assert opacities.grad is not None
    assert float(opacities.grad[0]) == 0.0 and float(opacities.grad[1]) == pytest.approx(0.01, rel=1e-3)


@pytest.mark.parametrize(("sigmas", "counts"), [(3.31, True), (3.34, False)])
def test_the_ellipse_of_least_alpha_is_the_only_cut(backend: Any, sigmas: float, counts: bool) -> None:
    # 0.98·exp(−r²/2) = 1/255 at r = 3.3231: beyond 3DGS's radius of 3 standard deviations.
    b, _ = stack(backend, [0.98], [1.0], offset_px=sigmas)
    assert (float(b.alpha.detach()) > 0.0) is counts
    assert int(b.dominant_id) == (0 if counts else -1)


def test_nothing_crosses_half_of_the_light(backend: Any) -> None:
    b, _ = stack(backend, [0.3, 0.2], [1.0, 2.0])
    assert int(b.median_id) == -1 and float(b.median_weight) == 0.0 and int(b.dominant_id) == 0


def test_splat_on_the_axis_peaks_at_the_principal_point(backend: Any) -> None:
    camera = Camera(21, 15, 30.0, 30.0, 12.0, 6.0)
    p = backend.project(
        torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[2.0, 0.0, 0.0, 0.0]]), torch.tensor([[0.1, 0.2, 0.1]]),
        torch.eye(4), camera, OPTIONS,
    )  # fmt: skip
    assert p.means2d[0].tolist() == [12.0, 6.0] and float(p.z[0]) == 2.0
    assert p.radii[0].tolist() == pytest.approx([(1.5**2 + 0.3) ** 0.5, (3.0**2 + 0.3) ** 0.5], rel=1e-5)
    assert p.conics[0].tolist() == pytest.approx([(1.5**2 + 0.3) ** -0.5, 0.0, (3.0**2 + 0.3) ** -0.5], rel=1e-5)
    b = backend.blend(*p, torch.tensor([0.7]), torch.ones(1, 1), None, camera, OPTIONS)
    assert float(b.alpha[6, 12]) == pytest.approx(0.7, rel=1e-5) and float(b.alpha.max()) == float(b.alpha[6, 12])
    torch.testing.assert_close(b.alpha[:, 12 - 8 : 12], b.alpha[:, 13:21].flip(1))
