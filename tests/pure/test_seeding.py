"""Seeding: which pixels become splats, where these lie and how large they are, on scenes with known answers."""

import itertools

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import constants
from paper_settings import SeedConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.fit.target import Target
from sigmasplat.fit.tracking_loss import PoseMaps
from sigmasplat.mapping.seeding import first_pixels, later_pixels, make_splats, thin_out
from sigmasplat.render.reference import rotations

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]
CAMERA = Camera(64, 48, 60.0, 61.0, 30.5, 24.5)
SIZE = (CAMERA.height, CAMERA.width)
SETTINGS = SeedConfig(
    first_uniform=300, first_gradient=200, first_edges=False, later_max=0, depth_error_least_m=0.1, max_splats=0
)


def changed(**values: object) -> SeedConfig:
    return constants.changed(SETTINGS, **values)


def random(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def target(depth_m: Array, color: Array | None = None) -> Target:
    """Lay a frame out on planes larger than it is, as a view's are."""
    if color is None:
        color = random(1).random((*SIZE, 3)).astype(np.float32)
    return Target.of(Frame(0, 0.0, color, depth_m.astype(np.float32), CAMERA), (64, 80))


def holey(depth_m: float = 2.0, share: float = 0.5) -> Array:
    """Make a wall with readings missing at random."""
    return np.where(random(2).random(SIZE) < share, 0.0, depth_m).astype(np.float32)


def maps(surface_m: Array, alpha: float | Array = 1.0) -> PoseMaps:
    """Say what a map renders: a surface seen through `alpha`."""
    a = torch.as_tensor(np.broadcast_to(np.asarray(alpha, np.float32), SIZE).copy())
    return PoseMaps(torch.zeros(*SIZE, 3), torch.as_tensor(surface_m) * a, a, None)


def field_at(points: Array) -> GaussianField:
    means = torch.as_tensor(points, dtype=torch.float32)
    return GaussianField.from_values(means, torch.full((len(means),), 0.01), torch.zeros(len(means), 3))


# ---- which pixels


@pytest.mark.parametrize("edges", [False, True])
def test_an_empty_map_is_seeded_only_where_depth_was_read(edges: bool) -> None:
    depth = holey()
    chosen = first_pixels(target(depth), changed(first_edges=edges), random())
    assert chosen.shape == SIZE and 300 <= chosen.sum() <= (500 if not edges else depth.size)
    assert not chosen[depth == 0].any()


def test_pixels_are_drawn_without_repetition() -> None:
    """Of n pixels wanted n come: a draw with repetition would give fewer."""
    depth = np.full(SIZE, 2.0, np.float32)
    for count in (1, 500, 3000):
        assert first_pixels(target(depth), changed(first_uniform=count, first_gradient=0), random()).sum() == count
    assert first_pixels(target(depth), changed(first_uniform=10**6, first_gradient=0), random()).all()


def test_texture_draws_splats() -> None:
    color = np.full((*SIZE, 3), 0.5, np.float32)
    color[:, 32:] = random(3).random((48, 32, 1))
    chosen = first_pixels(target(np.full(SIZE, 2.0), color), changed(first_uniform=0), random())
    assert chosen.sum() == 200 and not chosen[:, :31].any(), "a blank wall has no gradient"


def test_strong_texture_draws_in_proportion() -> None:
    """Stripes four times as strong in the right half: four of five seeds lie there."""
    gray = 0.5 + 0.4 * (np.arange(64) // 2 % 2 - 0.5) * np.where(np.arange(64) < 32, 0.25, 1.0)
    color = np.broadcast_to(gray[None, :, None], (*SIZE, 3)).astype(np.float32)
    seen = target(np.full(SIZE, 2.0), color)
    drawn = [first_pixels(seen, changed(first_uniform=0, first_gradient=60), random(seed)) for seed in range(30)]
    right = np.mean([chosen[:, 32:].sum() / chosen.sum() for chosen in drawn])
    assert right == pytest.approx(0.8, abs=0.04)


def test_edges_are_seeded_whatever_the_draw() -> None:
    color = np.zeros((*SIZE, 3), np.float32)
    color[:, 40:] = 1.0
    settings = changed(first_uniform=0, first_gradient=0, first_edges=True)
    rows, columns = np.nonzero(first_pixels(target(np.full(SIZE, 2.0), color), settings, random()))
    assert set(columns) <= set(range(37, 44)) and len(set(rows)) > 40


def test_draws_follow_from_the_seed() -> None:
    seen = target(holey())
    one, again, other = (first_pixels(seen, SETTINGS, random(seed)) for seed in (5, 5, 6))
    assert (one == again).all() and (one != other).any()


def test_a_thin_map_is_seeded_where_there_is_depth() -> None:
    depth = holey()
    alpha = np.ones(SIZE, np.float32)
    alpha[:, :20], alpha[:, 20:24] = 0.59, 0.61
    chosen = later_pixels(maps(np.full(SIZE, 2.0, np.float32), alpha), target(depth), SETTINGS)
    np.testing.assert_array_equal(chosen, (depth > 0) & (alpha < 0.6))


def noisy(metres: float = 0.01) -> Array:
    return (3.0 + metres * random(4).normal(size=SIZE)).astype(np.float32)


@pytest.mark.parametrize("alpha", [1.0, 0.7], ids=["opaque", "the surface is D/A"])
def test_an_object_that_appears_in_front_is_seeded_and_noise_is_not(alpha: float) -> None:
    depth = noisy()
    depth[10:20, 30:50] = 2.0  # a metre before the wall
    chosen = later_pixels(maps(np.full(SIZE, 3.0, np.float32), alpha), target(depth), SETTINGS)
    new = np.zeros(SIZE, bool)
    new[10:20, 30:50] = True
    np.testing.assert_array_equal(chosen, new)


def test_what_has_gone_behind_is_not_seeded() -> None:
    """The map's surface stands before the reading: a splat behind it would never be seen."""
    depth = noisy()
    depth[10:20, 30:50] = 4.0
    assert not later_pixels(maps(np.full(SIZE, 3.0, np.float32)), target(depth), SETTINGS).any()


def test_the_bound_is_the_factor_times_the_median_error_with_a_minimum_in_metres() -> None:
    depth, surface = np.full(SIZE, 3.0, np.float32), np.full(SIZE, 3.01, np.float32)  # the median error is 1 cm
    depth[0, 0], depth[0, 1] = 3.01 - 0.39, 3.01 - 0.41

    def chosen(**values: float) -> list[bool]:
        found = later_pixels(maps(surface), target(depth), changed(depth_error_factor=40.0, **values))
        assert not found[1:].any()
        return [bool(x) for x in found[0, :2]]

    assert chosen(depth_error_least_m=0.0) == [False, True]
    assert chosen(depth_error_least_m=0.5) == [False, False]


def test_without_a_factor_only_thin_places_are_seeded() -> None:
    alpha = np.ones(SIZE, np.float32)
    alpha[:, :20] = 0.49
    behind = maps(np.full(SIZE, 3.0, np.float32), alpha)
    for least_m in (0.0, 0.1):
        off = changed(depth_error_factor=0.0, depth_error_least_m=least_m)
        np.testing.assert_array_equal(later_pixels(behind, target(np.full(SIZE, 2.0)), off), alpha < 0.5)
    assert later_pixels(behind, target(np.full(SIZE, 2.0)), changed(depth_error_factor=0.5)).all(), "else all is new"


def test_density_and_limit_thin_pixels_out() -> None:
    pixels = random(5).random(SIZE) < 0.5
    n = int(pixels.sum())
    for density, limit, expected in ((1.0, 0, n), (0.35, 0, round(0.35 * n)), (0.35, 100, 100), (0.0, 0, 0)):
        kept = thin_out(pixels, changed(density=density, later_max=limit), random())
        assert kept.sum() == expected and not kept[~pixels].any()


def test_thinning_out_favours_no_part_of_the_image() -> None:
    kept = thin_out(np.ones(SIZE, bool), changed(density=0.35), random())
    assert np.allclose([kept[:24].mean(), kept[24:].mean(), kept[:, :32].mean(), kept[:, 32:].mean()], 0.35, atol=0.04)


# ---- which splats

SOME = np.zeros(SIZE, bool)
SOME[4::7, 3::9] = True
POSE = se3.exp(np.array([0.5, -0.2, 0.3, 0.4, -0.3, 0.2]))


def made(pixels: Mask, depth_m: Array, spacing_px: float = 1.0, field: GaussianField | None = None, **values: object):
    seen = target(depth_m)
    return make_splats(seen, POSE, pixels, spacing_px, field or GaussianField.empty(), changed(**values)), seen


def test_splats_lie_on_their_pixels_rays_behind_the_reading_by_push_back() -> None:
    for push_back in [1.0, 1.005, 1.02]:
        depth = random(6).uniform(1.0, 4.0, SIZE).astype(np.float32)
        field, seen = made(SOME, depth, opacity=0.8, scale_from="pixel", push_back=push_back)
        T = se3.inverse(POSE)
        x, y, z = T[:3, :3] @ field.means.numpy().T.astype(float) + T[:3, 3:]
        v, u = np.nonzero(SOME)
        np.testing.assert_allclose(CAMERA.fx * x / z + CAMERA.cx, u, atol=1e-3)
        np.testing.assert_allclose(CAMERA.fy * y / z + CAMERA.cy, v, atol=1e-3)
        np.testing.assert_allclose(z, push_back * depth[SOME], rtol=1e-5)
        np.testing.assert_allclose(field.colors.numpy(), seen.image.numpy()[SOME], rtol=1e-6)
        np.testing.assert_allclose(field.opacities.numpy(), 0.8, rtol=1e-5)
        np.testing.assert_allclose(field.variances.numpy(), np.exp(-7.0), rtol=1e-5)
        np.testing.assert_array_equal(field.quats.numpy(), np.tile([1.0, 0, 0, 0], (len(v), 1)))


def test_a_splats_size_is_its_pixels_times_the_spacing() -> None:
    depth = random(6).uniform(1.0, 4.0, SIZE).astype(np.float32)
    field, _ = made(SOME, depth, spacing_px=2.5, scale_from="pixel", scale_factor=0.8)
    expected = 0.8 * 2.5 * depth[SOME] / CAMERA.fx
    np.testing.assert_allclose(field.scales.numpy(), np.repeat(expected[:, None], 3, 1), rtol=1e-5)


def test_a_splats_size_is_the_mean_distance_of_three_neighbours_old_and_new() -> None:
    """Four new points and one old, all distances by hand."""
    pixels, depth = np.zeros(SIZE, bool), np.full(SIZE, 2.0, np.float32)
    pixels[20, [10, 20, 30, 40]] = True
    spread_m = 2.0 * SETTINGS.push_back * 10 / CAMERA.fx  # between neighbours in the row

    def sizes(old: list[list[float]]) -> list[float]:
        field, _ = made(pixels, depth, field=field_at(np.array(old, np.float32)) if old else None)
        return [float(s) for s in field.scales[:, 0] / spread_m]

    end, middle = np.sqrt((1 + 4 + 9) / 3), np.sqrt((1 + 1 + 4) / 3)
    np.testing.assert_allclose(sizes([]), [end, middle, middle, end], rtol=1e-5)
    ray = CAMERA.rays()[20, 10].astype(float) * 2.0 * SETTINGS.push_back + [0.0, 0.5 * spread_m, 0.0]
    beside_the_first = (POSE[:3, :3] @ ray + POSE[:3, 3]).tolist()
    found = sizes([beside_the_first])
    assert found[0] == pytest.approx(np.sqrt((0.25 + 1 + 4) / 3), rel=1e-4)
    assert found[3] == pytest.approx(end, rel=1e-4), "the others keep theirs"


def slanted(normal: tuple[float, float, float], through_m: float = 2.0) -> Array:
    """Make the depth of a plane that crosses the optical axis at a distance."""
    n = np.array(normal) / np.linalg.norm(normal)
    return np.asarray(through_m * n[2] / (CAMERA.rays() @ n), np.float32)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (-0.3, 0.5, 1.0)])
def test_discs_lie_on_the_surface(normal: tuple[float, float, float]) -> None:
    depth, n = slanted(normal), np.array(normal) / np.linalg.norm(normal)
    field, _ = made(SOME, depth, scale_from="pixel", thickness=0.2, scale_factor=0.8)
    round_ones, _ = made(SOME, depth, scale_from="pixel", scale_factor=0.8)
    rays = CAMERA.rays()[SOME]
    cosine = np.abs(rays @ n) / np.linalg.norm(rays, axis=1)
    axes = POSE[:3, :3].T @ rotations(field.quats).numpy()
    np.testing.assert_allclose(np.abs(axes[:, :, 2] @ n), 1.0, atol=1e-4)
    shape = field.scales.numpy() / round_ones.scales.numpy()
    np.testing.assert_allclose(shape, np.stack([1.0 / cosine, 1.0 + 0 * cosine, 0.2 + 0 * cosine], 1), rtol=1e-3)
    np.testing.assert_array_equal(field.means.numpy(), round_ones.means.numpy())


def test_a_seed_beside_a_hole_or_a_step_is_round() -> None:
    depth = np.full(SIZE, 2.0, np.float32)
    depth[:, 31:] = 3.0
    depth[10, 10] = 0.0
    pixels = np.zeros(SIZE, bool)
    pixels[[10, 20, 20, 30], [11, 30, 31, 12]] = True
    field, _ = made(pixels, depth, scale_from="pixel", thickness=0.1)
    ratio = (field.scales.amin(1) / field.scales.amax(1)).numpy()
    np.testing.assert_allclose(ratio, [1.0, 1.0, 1.0, 0.1], atol=0.01)
    assert made(pixels * False, depth, thickness=0.1)[0].params.shape == (0, 17)


def test_new_splats_keep_their_distance_from_old_ones() -> None:
    depth = np.full(SIZE, 2.0, np.float32)
    first, _ = made(SOME, depth, min_distance_m=0.0)
    near = GaussianField(first.params[::2].clone())
    near.params[:, 0] += 0.004
    kept, _ = made(SOME, depth, field=near, min_distance_m=0.01)
    np.testing.assert_allclose(kept.means.numpy(), first.means.numpy()[1::2], atol=1e-5)
    assert len(made(SOME, depth, field=near, min_distance_m=0.001)[0]) == len(first)


def test_a_stray_reading_is_removed_where_asked() -> None:
    depth = np.full(SIZE, 2.0, np.float32)
    depth[4, 3] = 7.9
    everything, _ = made(SOME, depth)
    kept, _ = made(SOME, depth, outlier_neighbours=8)
    stray = np.linalg.norm(everything.means.numpy() - POSE[:3, 3], axis=1) > 5
    assert stray.sum() == 1
    # Seeds at the corners are lonelier than most too; what matters is that the stray one goes and nearly all stay.
    assert np.linalg.norm(kept.means.numpy() - POSE[:3, 3], axis=1).max() < 5 and len(kept) > 0.8 * len(everything)


def test_a_stray_reading_stays_in_an_empty_map_where_asked() -> None:
    depth = np.full(SIZE, 2.0, np.float32)
    depth[4, 3] = 7.9
    old = field_at(np.array([[50.0, 0.0, 0.0]]))
    first, later = (
        made(SOME, depth, field=field, outlier_neighbours=8, outlier_first=False)[0] for field in (None, old)
    )
    assert np.linalg.norm(first.means.numpy() - POSE[:3, 3], axis=1).max() > 5
    assert np.linalg.norm(later.means.numpy() - POSE[:3, 3], axis=1).max() < 5


def test_the_number_of_pixels_is_the_number_of_splats() -> None:
    for count, scale_from in itertools.product([0, 1, 3], ["pixel", "neighbours"]):
        pixels = np.zeros(SIZE, bool)
        pixels[5, 5 : 5 + count] = True
        field, _ = made(pixels, np.full(SIZE, 2.0, np.float32), scale_from=scale_from)
        assert len(field) == count and bool(torch.isfinite(field.params).all())


def test_no_splat_is_smaller_than_a_tenth_of_a_millimetre() -> None:
    assert float(made(SOME, np.full(SIZE, 2.0, np.float32), 1e-6, scale_from="pixel")[0].scales.min()) >= 0.99e-4
