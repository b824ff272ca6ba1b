"""The predictive variance: its parts against Monte Carlo in double precision, and the same parts on every backend."""

import numpy as np
import pytest
import torch

from paper_settings import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.render import render
from sigmasplat.uncertainty.calibration import splat_residuals
from sigmasplat.uncertainty.map_uncertainty import (
    COLOR_PARTS,
    DEPTH_PARTS,
    SHIPPED,
    Background,
    Calibration,
    MapUncertainty,
)
from sigmasplat.uncertainty.predictive import blend_values, novelty, predict, variance_parts
from splat_scenes import WIDE, Scene, assert_same_vector, scene

BACKGROUND = Background((0.4, 0.5, 0.3), 0.05, 0.8)
NOTHING = Background((0.5, 0.5, 0.5), 0.0, 0.0)
OPTIONS = RenderConfig()


def field_of(s: Scene) -> GaussianField:
    """Return the splats of a scene with random colours and σ²."""
    numbers = torch.Generator().manual_seed(3)
    n = len(s.means)
    logits = (s.opacities / (1.0 - s.opacities)).log()[:, None]
    colors, log_variances = torch.rand(n, 3, generator=numbers), -5.0 + torch.rand(n, 3, generator=numbers)
    columns = [s.means, s.quats, s.scales.log(), logits, colors.to(s.means), log_variances.to(s.means)]
    return GaussianField(torch.cat(columns, 1))


def splats(n: int) -> torch.Tensor:
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(4)) * 0.01


def directions(n: int) -> torch.Tensor:
    """Draw unit vectors."""
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=torch.Generator().manual_seed(5)), dim=1)


def test_mixture_and_unexplained_light_are_the_squared_error_of_the_render_against_a_drawn_color() -> None:
    """A pixel shows splat i with probability w_i, with noise σ_i, and the background with probability 1 − A."""
    s = scene("random", 40, WIDE)
    field, T = field_of(s), s.T_camera_world.numpy()
    parts = variance_parts(field, splats(40).double(), BACKGROUND, WIDE, T, OPTIONS, "reference")
    row, column = 15, 22
    one = torch.zeros(WIDE.height, WIDE.width, 1, dtype=torch.float64)
    one[row, column] = 1.0
    weights = blend_values(field, WIDE, T, splats(40), OPTIONS, "reference", gather=True).gather(one)[:, 0].numpy()
    rng = np.random.default_rng(0)
    chosen = rng.choice(41, 400_000, p=[*weights, 1.0 - weights.sum()])
    means = np.concatenate([field.colors.numpy(), [BACKGROUND.color]])
    stds = np.concatenate([field.variances.sqrt().numpy(), np.full((1, 3), BACKGROUND.color_variance**0.5)])
    drawn = means[chosen] + stds[chosen] * rng.normal(size=(len(chosen), 3))
    total = parts.color[COLOR_PARTS.index("mixture")] + parts.color[COLOR_PARTS.index("unexplained")]
    assert 0.1 < weights.sum() < 0.999
    error2 = (drawn - parts.image[row, column].numpy()) ** 2
    assert float(total[row, column]) == pytest.approx(error2.mean(), rel=0.01)


def test_where_the_map_is_empty_the_background_alone_is_predicted() -> None:
    parts = variance_parts(GaussianField.empty(), torch.zeros(0, 3), BACKGROUND, WIDE, np.eye(4), OPTIONS, "reference")
    black2 = sum(c**2 for c in BACKGROUND.color) / 3
    expected = {"unexplained": BACKGROUND.color_variance + black2, "floor": 1.0}
    for name, plane in zip(COLOR_PARTS, parts.color, strict=True):
        assert torch.allclose(plane, torch.full_like(plane, expected.get(name, 0.0))), name
    for name, plane in zip(DEPTH_PARTS, parts.depth, strict=True):
        wanted = {"unexplained": BACKGROUND.depth_variance_m2, "floor": 1.0}.get(name, 0.0)
        assert torch.allclose(plane, torch.full_like(plane, wanted)), name


def test_every_backend_renders_the_same_parts(kernels: str) -> None:
    s = scene("random", 60, WIDE)
    field, T = field_of(s), s.T_camera_world.numpy()
    values = torch.cat([splats(60), 0.9 * directions(60)], 1)
    exact = variance_parts(field, values.double(), BACKGROUND, WIDE, T, OPTIONS, "reference")
    single = GaussianField(field.params.float())
    found = variance_parts(single, values, BACKGROUND, WIDE, T, OPTIONS, kernels)
    for name, plane, want in zip(
        (*COLOR_PARTS, *DEPTH_PARTS), (*found.color, *found.depth), (*exact.color, *exact.depth), strict=True
    ):
        assert_same_vector(plane, want, what=name)


def test_a_prediction_is_the_weighted_sum_of_its_parts_and_leaves_the_published_variance_alone(kernels: str) -> None:
    s = scene("random", 60, WIDE).to(torch.float32)
    field, T, values = field_of(s), s.T_camera_world.numpy(), splats(60)
    before = render(field, WIDE, T, backend=kernels).variance
    parts = variance_parts(field, values, BACKGROUND, WIDE, T, OPTIONS, kernels)
    color, depth = dict.fromkeys(COLOR_PARTS, 2.0), dict.fromkeys(DEPTH_PARTS, 3.0)
    found = predict(field, MapUncertainty(values, BACKGROUND, Calibration(color, depth)), WIDE, T, OPTIONS, kernels)
    assert torch.allclose(found.color, 2.0 * parts.color.sum(0), rtol=1e-5)
    assert torch.allclose(found.reading_m2, 3.0 * parts.depth.sum(0), rtol=1e-5)
    noise = sum(parts.depth[DEPTH_PARTS.index(name)] for name in ("residual", "sensor"))
    assert torch.allclose(found.depth_std_m.square(), 3.0 * (parts.depth.sum(0) - noise + parts.systematic), rtol=1e-4)
    assert torch.equal(found.color, found.color_aleatoric + found.color_epistemic)
    shipped = predict(field, MapUncertainty(values, BACKGROUND, SHIPPED), WIDE, T, OPTIONS, kernels)
    assert float(shipped.color.min()) > 0.0 and float(shipped.depth_std_m.min()) > 0.0
    assert torch.equal(render(field, WIDE, T, backend=kernels).variance, before)


def wall() -> tuple[GaussianField, torch.Tensor]:
    """Return a gray wall at 2 m with a splat in each pixel, and the pixels [N, 2]."""
    rows = torch.arange(WIDE.height * WIDE.width)
    at = torch.stack([rows % WIDE.width, rows // WIDE.width], 1).float()
    sides = (at - torch.tensor([WIDE.cx, WIDE.cy])) / torch.tensor([WIDE.fx, WIDE.fy]) * 2.0
    means = torch.cat([sides, torch.full_like(at[:, :1], 2.0)], 1)
    return GaussianField.from_values(means, torch.full_like(means, 0.03), torch.full_like(means, 0.5)), at


def test_the_residuals_of_splats_are_the_noise_of_the_images() -> None:
    """Noise of two standard deviations in the two halves of the images; no other error."""
    field, at = wall()
    seen, rng = render(field, WIDE, np.eye(4)), np.random.default_rng(0)
    noise = torch.where(torch.arange(WIDE.width) < 22, 0.02, 0.06)
    keyframes = []
    for i in range(12):
        image = seen.color + noise[None, :, None] * torch.from_numpy(rng.normal(size=seen.color.shape)).float()
        color, depth = torch.zeros(3, *image.shape[:2]), seen.depth / seen.alpha
        color[:] = image.movedim(-1, 0)
        depth = depth + 0.5 * noise * torch.from_numpy(rng.normal(size=depth.shape)).float()
        keyframes.append(Keyframe(i, Target(WIDE, color, depth, depth.numel()), np.eye(4)))
    found = splat_residuals(field, keyframes, OPTIONS, "cpu")
    for inside, std in ((at[:, 0] < 18, 0.02), (at[:, 0] > 26, 0.06)):
        assert float(found[inside, 0].median()) ** 0.5 == pytest.approx(std, rel=0.15)
        assert float(found[inside, 1].median()) ** 0.5 == pytest.approx(0.5 * std, rel=0.15)


def test_the_depth_of_a_splat_is_surer_than_a_reading_unless_all_readings_disagree_with_it() -> None:
    """Readings with noise of 5 cm; in one half of the images all are 10 cm too far."""
    field, at = wall()
    seen, rng = render(field, WIDE, np.eye(4)), np.random.default_rng(0)
    off_m = torch.where(torch.arange(WIDE.width) < 22, 0.0, 0.1)
    keyframes = []
    for i in range(12):
        depth = seen.depth / seen.alpha + off_m + 0.05 * torch.from_numpy(rng.normal(size=seen.depth.shape)).float()
        target = Target(WIDE, seen.color.movedim(-1, 0).contiguous(), depth, depth.numel())
        keyframes.append(Keyframe(i, target, np.eye(4)))
    own = splat_residuals(field, keyframes, OPTIONS, "cpu")[:, 2].sqrt()
    assert float(own[at[:, 0] < 18].median()) < 0.02
    assert float(own[at[:, 0] > 26].median()) == pytest.approx(0.1, rel=0.2)


def test_only_views_beyond_the_seen_directions_are_extrapolated() -> None:
    field, _ = wall()
    seen = render(field, WIDE, np.eye(4))
    target = Target(WIDE, seen.color.movedim(-1, 0).contiguous(), seen.depth / seen.alpha, seen.depth.numel())
    sideways, far = (camera_beside_the_wall(angle) for angle in (0.15, 0.9))
    keyframes = [Keyframe(0, target, np.eye(4)), Keyframe(1, target, sideways)]
    seen_from = splat_residuals(field, keyframes, OPTIONS, "cpu")[:, 3:]
    both = (seen_from != 0.0).any(1) & (seen_from.norm(dim=1) < 0.999)
    assert both.sum() > 100, "splats that both keyframes see"
    for T_map_camera in (np.eye(4), sideways):
        assert float(novelty(field.means, seen_from, se3.inverse(T_map_camera))[both].quantile(0.9)) < 0.1
    assert float(novelty(field.means, seen_from, se3.inverse(far))[both].min()) > 0.9
    assert not novelty(field.means, seen_from[:, :0], se3.inverse(far)).any(), "directions are not known"


def camera_beside_the_wall(angle_rad: float) -> np.ndarray:
    """Return T_map_camera of a camera that is turned about a vertical axis through the wall at 2 m."""
    T = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, angle_rad, 0.0]))
    T[:3, 3] = np.array([0.0, 0.0, 2.0]) - T[:3, :3] @ np.array([0.0, 0.0, 2.0])
    return T
