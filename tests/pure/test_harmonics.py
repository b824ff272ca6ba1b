"""Spherical harmonics: what they are, that they turn with the field, and colours as cameras see them."""

import numpy as np
import pytest
import torch
from torch import Tensor

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import ATTRIBUTES, GaussianField, Rows
from sigmasplat.data.harmonics import basis, count, turned, view_colors
from sigmasplat.errors import ConfigError
from sigmasplat.render import render

CAMERA = Camera(24, 18, 22.0, 22.0, 11.3, 8.6)


def random_directions(n: int, seed: int = 0) -> Tensor:
    d = torch.as_tensor(np.random.default_rng(seed).normal(size=(n, 3)))
    return d / d.norm(dim=1, keepdim=True)


def sphere_rule() -> tuple[Tensor, Tensor]:
    """Return directions and weights that integrate polynomials up to degree 7 over the sphere exactly."""
    z, weight = np.polynomial.legendre.leggauss(8)
    turn = np.arange(16) * np.pi / 8
    r = np.sqrt(1 - z**2)
    x, y = np.outer(r, np.cos(turn)), np.outer(r, np.sin(turn))
    directions = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], -1).reshape(-1, 3)
    return torch.as_tensor(directions), torch.as_tensor(np.repeat(weight * np.pi / 8, 16))


def test_they_are_orthonormal_and_without_mean() -> None:
    directions, weights = sphere_rule()
    assert float(weights.sum()) == pytest.approx(4 * np.pi)
    Y = torch.cat([torch.full((len(directions), 1), 0.5 / np.sqrt(np.pi), dtype=torch.float64), basis(directions)], 1)
    torch.testing.assert_close(Y.T @ (weights[:, None] * Y), torch.eye(16).double(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_order_and_signs_are_those_of_the_complex_ones(degree: int) -> None:
    """√2 · Im, Y₀, √2 · Re of the complex harmonics with Condon–Shortley phase, m = −l … l: what 3DGS files hold."""
    from scipy.special import sph_harm_y

    directions = random_directions(20)
    x, y, z = directions.numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    want = [
        np.sqrt(2) * sph_harm_y(degree, -m, polar, azimuth).imag if m < 0
        else sph_harm_y(degree, 0, polar, azimuth).real if m == 0
        else np.sqrt(2) * sph_harm_y(degree, m, polar, azimuth).real
        for m in range(-degree, degree + 1)
    ]  # fmt: skip
    found = basis(directions)[:, count(degree - 1) : count(degree)]
    np.testing.assert_allclose(found.numpy(), np.stack(want, 1), atol=1e-12)
    assert torch.equal(basis(directions, degree), basis(directions)[:, : count(degree)])


def test_degree_1_is_written_out() -> None:
    """The first three, as any 3DGS viewer has them: −y, z, −x times √(3/4π)."""
    d = torch.tensor([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]])
    torch.testing.assert_close(basis(d, 1), 0.4886025 * torch.tensor([[-0.6, 0.8, 0.0], [0.0, 0.0, -1.0]]))


def test_there_is_no_fourth_degree() -> None:
    assert [count(degree) for degree in range(4)] == [0, 3, 8, 15] and ATTRIBUTES["harmonics"] == 3 * count(3)
    for degree in (-1, 4):
        with pytest.raises(ConfigError, match=f"degrees 0 to 3, found {degree}"):
            count(degree)


def test_colours_are_the_sum_over_harmonics_by_channel() -> None:
    rng = np.random.default_rng(3)
    colors, k, means, at = (torch.as_tensor(rng.normal(size=s)) for s in ((6, 3), (6, 45), (6, 3), (3,)))
    toward = (means - at) / (means - at).norm(dim=1, keepdim=True)
    for degree in range(4):
        n = count(degree)
        want = [
            [
                float(colors[i, c]) + sum(float(basis(toward)[i, j] * k[i, 3 * j + c]) for j in range(n))
                for c in range(3)
            ]
            for i in range(6)
        ]
        torch.testing.assert_close(view_colors(colors, k, means, at, degree), torch.tensor(want).double())


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_every_gradient_is_that_of_finite_differences(degree: int) -> None:
    rng = np.random.default_rng(4)
    given = [torch.as_tensor(rng.normal(size=s)).requires_grad_() for s in ((4, 3), (4, 45), (4, 3), (3,))]
    assert torch.autograd.gradcheck(lambda *x: view_colors(*x, degree), given)


def test_a_splat_in_the_camera_itself_has_finite_colour_and_gradient() -> None:
    means = torch.zeros(1, 3, requires_grad=True)
    shown = view_colors(torch.ones(1, 3), torch.ones(1, 45), means, torch.zeros(3))
    (g,) = torch.autograd.grad(shown.sum(), means)
    assert torch.isfinite(shown).all() and torch.isfinite(g).all()


@pytest.mark.parametrize("seed", range(3))
def test_turned_harmonics_are_the_same_function_in_other_axes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    k, R = torch.as_tensor(rng.normal(size=(5, 45))), torch.as_tensor(se3.exp(rng.normal(size=6) * 2)[:3, :3])
    d, zero, origin = random_directions(5, seed + 10), torch.zeros(5, 3).double(), torch.zeros(3).double()
    for degree in (1, 2, 3):  # each degree on its own: they do not mix
        part = k.clone()
        part[:, 3 * count(degree) :] = 0.0
        new = turned(part, R)
        assert torch.count_nonzero(new[:, 3 * count(degree) :].abs() > 1e-12) == 0
        want = view_colors(zero, part, d, origin, degree)
        torch.testing.assert_close(view_colors(zero, new, d @ R.T, origin, degree), want, rtol=0, atol=1e-12)
    torch.testing.assert_close(turned(turned(k, R), R.T), k, rtol=0, atol=1e-12)


def shiny_field(n: int = 40, seed: int = 0) -> GaussianField:
    rng = np.random.default_rng(seed)
    means = torch.as_tensor(rng.uniform([-1, -0.7, 1.0], [1, 0.7, 3.0], (n, 3))).float()
    scales, colors = (
        torch.as_tensor(rng.uniform(0.05, 0.3, (n, 3))).float(),
        torch.as_tensor(rng.random((n, 3))).float(),
    )
    field = GaussianField.from_values(means, scales, colors, opacities=0.7)
    field.attributes["harmonics"] = Rows(torch.as_tensor(rng.normal(0, 0.3, (n, 45))).float(), steps=4)
    return field


@pytest.mark.parametrize("seed", range(3))
def test_field_and_camera_that_move_together_see_the_same(seed: int) -> None:
    field, M = shiny_field(seed=seed), se3.exp(np.random.default_rng(seed).normal(size=6))
    moved = field.moved(torch.as_tensor(M))
    before, after = (
        render(f, CAMERA, torch.as_tensor(T).float(), backend="reference")
        for f, T in ((field, np.eye(4)), (moved, se3.inverse(M)))
    )
    for a, b in ((before.color, after.color), (before.variance, after.variance)):
        assert float((a - b).norm()) < 1e-4 * float(a.norm())
    unturned = field.moved(torch.as_tensor(M))
    unturned.attributes["harmonics"] = field.attributes["harmonics"]
    off = render(unturned, CAMERA, torch.as_tensor(se3.inverse(M)).float(), backend="reference").color - before.color
    assert float(off.norm()) > 0.05 * float(before.color.norm()), "the harmonics matter"


def test_turning_does_not_depend_on_where_memory_lies() -> None:
    k, R = torch.randn(4000, 45, generator=torch.Generator().manual_seed(0)), torch.as_tensor(se3.exp(np.arange(6.0)))
    want = turned(k, R[:3, :3].float())
    for offset in range(1, 6):
        room = torch.empty(k.numel() + 8)
        shifted = room[offset : offset + k.numel()].view(k.shape)
        shifted.copy_(k)
        assert torch.equal(turned(shifted, R[:3, :3].float()), want)


def test_what_is_moved_shares_no_memory_and_keeps_every_extra() -> None:
    field = shiny_field()
    moved = field.moved(torch.eye(4))
    assert set(moved.attributes) == {"harmonics"} and moved.attributes["harmonics"].steps == 4
    torch.testing.assert_close(moved.attributes["harmonics"].params, field.attributes["harmonics"].params)
    for attribute in moved.attributes.values():
        attribute.params += 1.0
        attribute.moment1 += 1.0
    assert torch.equal(field.attributes["harmonics"].params, shiny_field().attributes["harmonics"].params)
    assert torch.count_nonzero(field.attributes["harmonics"].moment1) == 0


def test_a_render_shows_what_the_camera_sees() -> None:
    """Against the same field with the view's colours painted on; and its gradient reaches harmonics."""
    field, T = shiny_field(), se3.exp(np.array([0.1, -0.2, 0.3, 0.1, 0.2, -0.1]))
    position = torch.as_tensor(se3.inverse(T)[:3, 3]).float()
    painted = GaussianField(field.params.clone())
    painted.params[:, 11:14] = view_colors(field.colors, field.attributes["harmonics"].params, field.means, position)
    leaf = field.attributes["harmonics"].params.requires_grad_()
    seen, want = (render(f, CAMERA, torch.as_tensor(T), backend="reference") for f in (field, painted))
    torch.testing.assert_close(seen.color, want.color, rtol=0, atol=1e-6)
    torch.testing.assert_close(seen.variance, want.variance, rtol=0, atol=1e-5)
    (g,) = torch.autograd.grad(seen.color.sum(), leaf)
    assert torch.count_nonzero(g) > 45
