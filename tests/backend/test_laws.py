"""Laws of splatting that hold for every scene and every backend, in float32."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from sigmasplat.data import se3
from sigmasplat.data.field import left_factor, quaternion_of, transformed
from splat_oracle import depths, flat, jacobian
from splat_scenes import SMALL, Scene, assert_same_vector, make, probe, render, scene, twist_gradient

COUNT = 10
MARGIN = 5e-4
seeds = st.integers(0, 20)
kinds = st.sampled_from(["random", "needles", "huge", "off_screen", "overlapping"])
laws = settings(max_examples=10, deadline=None, derandomize=True, database=None)


def scene32(kind: str, seed: int) -> Scene:
    """Make a small float32 scene whose decisions survive rounding."""
    return scene(kind, COUNT, SMALL, MARGIN, seed).to(torch.float32)


def assert_same_maps(a: Any, b: Any, atol: float = 1e-4) -> None:
    """Hold the maps of two renders together."""
    for name in ("sums", "moment", "alpha", "median_weight", "dominant_weight"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=1e-4, atol=atol)


@laws
@given(kinds, seeds)
def test_moving_field_and_camera_together_changes_nothing(backend: Any, kind: str, seed: int) -> None:
    s = scene32(kind, seed)
    move = torch.as_tensor(se3.exp(np.random.default_rng(seed).normal(size=6)))
    back = torch.as_tensor(se3.inverse(move.numpy()))
    moved = replace(
        s,
        means=(s.means.double() @ move[:3, :3].T + move[:3, 3]).float(),
        quats=transformed(s.quats.double(), left_factor(quaternion_of(move[:3, :3]))).float(),
        T_camera_world=(s.T_camera_world.double() @ back).float(),
    )
    a, b = render(backend, s)[1], render(backend, moved)[1]
    assert_same_maps(a, b)
    assert torch.equal(a.median_id, b.median_id)


@laws
@given(kinds, seeds)
def test_alpha_and_the_light_left_make_one(backend: Any, kind: str, seed: int) -> None:
    s = scene32(kind, seed)
    p, b = render(backend, s)
    n, stop = len(s.means), s.options.transmittance_stop
    wall = backend.blend(
        torch.cat([p.means2d, torch.tensor([[SMALL.cx, SMALL.cy]])]),
        torch.cat([p.conics, torch.tensor([[1e-4, 0.0, 1e-4]])]),
        torch.cat([p.z, torch.tensor([100.0])]),
        torch.cat([p.radii, torch.tensor([[1e4, 1e4]])]),
        torch.cat([s.opacities, torch.ones(1)]),
        torch.cat([torch.zeros(n, 1), torch.ones(1, 1)]),
        None, s.camera, s.options,
    )  # fmt: skip
    light = wall.sums[..., 0] / 0.99
    through = 1 - b.alpha > 2 * stop
    assert bool((b.alpha >= 0).all()) and bool((b.alpha <= 1 + 1e-6).all())
    assert float((b.alpha + light - 1)[through].abs().max()) < 2e-6


@laws
@given(kinds, seeds, st.booleans())
def test_variance_is_never_negative(backend: Any, kind: str, seed: int, one_color: bool) -> None:
    s = scene32(kind, seed)
    colors = s.features[:1].expand(len(s.means), -1) if one_color else s.features
    spread = torch.zeros_like(colors) if seed % 2 else torch.full_like(colors, 1e-3)
    sums = render(backend, replace(s, features=torch.cat([colors, spread + colors**2], 1)))[1].sums
    mean, square = sums.split(4, -1)
    assert float((square - mean**2).min()) >= -1e-6


@laws
@given(kinds, seeds)
def test_order_of_rows_changes_nothing(backend: Any, kind: str, seed: int) -> None:
    s = scene32(kind, seed)
    rows = torch.as_tensor(np.random.default_rng(seed).permutation(len(s.means)))
    names = ("means", "quats", "scales", "opacities", "features")
    a, b = render(backend, s)[1], render(backend, replace(s, **{k: getattr(s, k)[rows] for k in names}))[1]
    assert_same_maps(a, b, 1e-6)
    for before, after in ((a.median_id, b.median_id), (a.dominant_id, b.dominant_id)):
        assert torch.equal(torch.where(after >= 0, rows[after.clamp(min=0).long()], -1), before.long())


@laws
@given(kinds, seeds, st.floats(0.5, 3.0))
def test_scaling_the_world_scales_depth_only(backend: Any, kind: str, seed: int, k: float) -> None:
    s = scene32(kind, seed)
    T = s.T_camera_world.clone()
    T[:3, 3] *= k
    larger = replace(s, means=s.means * k, scales=s.scales * k, ref_depth=s.ref_depth * k, T_camera_world=T)
    (p, a), (q, b) = render(backend, s), render(backend, larger)
    assert_same_maps(a, b._replace(moment=b.moment / k**2))
    torch.testing.assert_close(q.z, p.z * k, rtol=1e-5, atol=1e-5)


@laws
@given(kinds, seeds, st.floats(0.2, 5.0))
def test_length_of_quaternions_means_nothing(backend: Any, kind: str, seed: int, k: float) -> None:
    s = scene32(kind, seed)
    assert_same_maps(render(backend, s)[1], render(backend, replace(s, quats=s.quats * k))[1])
    leaves = s.requiring_grad()
    b = render(backend, leaves)[1]
    probe(b.sums, b.moment, b.alpha).backward()
    gradient = leaves.quats.grad
    assert gradient is not None
    along = (gradient * s.quats).sum(1) / s.quats.norm(dim=1)
    assert float(along.norm()) < 1e-5 * float(gradient.norm())


@laws
@given(kinds, seeds)
def test_pushing_the_world_is_pushing_the_camera(backend: Any, kind: str, seed: int) -> None:
    leaves = scene32(kind, seed).requiring_grad()
    b = render(backend, leaves)[1]
    probe(b.sums, b.moment, b.alpha).backward()
    assert leaves.means.grad is not None and leaves.T_camera_world.grad is not None
    R = leaves.T_camera_world.detach()[:3, :3]
    assert_same_vector(leaves.T_camera_world.grad[:3, 3], R @ leaves.means.grad.sum(0), what=f"{kind} ∂L/∂t")


def covariance_only(backend: Any, s: Scene) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Differentiate by quaternions, by means (in the camera frame) and by the twist, through the conics alone."""
    x = s.requiring_grad()
    p = backend.project(x.means, x.quats, x.scales, x.T_camera_world, x.camera, x.options)
    p = p._replace(means2d=p.means2d.detach(), z=p.z.detach())
    b = backend.blend(*p, s.opacities, s.features, s.ref_depth, s.camera, s.options)
    probe(b.sums, b.alpha).backward()
    assert x.quats.grad is not None and x.means.grad is not None and x.T_camera_world.grad is not None
    h = x.means.grad.double() @ s.T_camera_world[:3, :3].double().T
    return x.quats.grad, h, twist_gradient(x.T_camera_world.grad, s.T_camera_world)


def camera_points(s: Scene) -> torch.Tensor:
    """Bring means to the camera frame, float64 [N, 3]."""
    T = s.T_camera_world.double()
    return s.means.double() @ T[:3, :3].T + T[:3, 3]


@laws
@given(seeds)
def test_turning_round_splats_changes_no_covariance(backend: Any, seed: int) -> None:
    """CG-SLAM spec §2.1, Fact: for Σ = s²I the covariance-rotation term vanishes, ∂L/∂φ = Σ p × h."""
    s = make("random", COUNT, SMALL, seed).to(torch.float32)
    needles, balls = s, replace(s, scales=s.scales[:, :1].expand(-1, 3))
    quats, h, twist = covariance_only(backend, balls)
    assert_same_vector(twist[3:], torch.linalg.cross(camera_points(s), h).sum(0), what="∂L/∂φ against Σ p × h")
    turned, h_needles, twist_needles = covariance_only(backend, needles)
    assert float(quats.norm()) < 1e-4 * float(turned.norm())
    rotation_term = twist_needles[3:] - torch.linalg.cross(camera_points(s), h_needles).sum(0)
    assert float(rotation_term.norm()) > 1e-2 * float(twist_needles[3:].norm()), "stretched splats must feel the turn"


def paper_twist(s: Scene, push: Any) -> tuple[Any, Any]:
    """Derive ∂L/∂(ρ, φ) through the covariance of the only splat, and the rotation term in it, L = Σ push·α (numpy).

    CG-SLAM spec §2.1: K = ½ Σ a e eᵀ, h through J, 2(X23 − X32, …) with X = M Jᵀ K J through R.
    """
    T, c = s.T_camera_world.numpy(), s.camera
    (x, y, z) = p = T[:3, :3] @ s.means[0].numpy() + T[:3, 3]
    mean, covariance, _ = flat(s, 0)
    v, u = np.mgrid[: c.height, : c.width].astype(float)
    d = mean - np.stack([u, v], -1)
    e = d @ np.linalg.inv(covariance)
    alpha = float(s.opacities[0]) * np.exp(-0.5 * (d * e).sum(-1))
    K = 0.5 * np.einsum("hw,hwi,hwj->ij", np.where(alpha >= s.options.alpha_min, push * alpha, 0.0), e, e)
    R, J = T[:3, :3] @ se3.rotation_from_quaternion(s.quats[0].numpy()), jacobian(p, s)
    M = R @ np.diag(s.scales[0].numpy() ** 2) @ R.T
    A, X = 2 * K @ J @ M, M @ J.T @ K @ J
    h = np.array([-c.fx * A[0, 2], -c.fy * A[1, 2], -c.fx * A[0, 0] - c.fy * A[1, 1]]) / z**2
    h[2] += 2 * (c.fx * x * A[0, 2] + c.fy * y * A[1, 2]) / z**3
    turn = 2 * np.array([X[1, 2] - X[2, 1], X[2, 0] - X[0, 2], X[0, 1] - X[1, 0]])
    return np.concatenate([h, np.cross(p, h) + turn]), turn


@pytest.mark.parametrize("scales", [[0.25, 0.25, 0.25], [0.1, 0.3, 0.2]], ids=["round", "stretched"])
def test_covariance_path_of_one_splat_equals_the_derivation_on_paper(backend: Any, scales: list[float]) -> None:
    s = make("random", 1, SMALL, 3, channels=1)
    s = replace(s, scales=torch.tensor([scales]), opacities=torch.tensor([0.6]), features=torch.ones(1, 1))
    s = s.to(torch.float64)
    push = np.random.default_rng(7).normal(size=(SMALL.height, SMALL.width))
    want, turn = paper_twist(s, push)
    assert (np.abs(turn).max() < 1e-7) == (len(set(scales)) == 1)
    twists = []
    for path in (True, False):
        leaves = s.with_options(covariance_pose_gradient=path).to(torch.float32).requiring_grad()
        (render(backend, leaves)[1].sums[..., 0] * torch.as_tensor(push)).sum().backward()
        assert leaves.T_camera_world.grad is not None
        twists.append(twist_gradient(leaves.T_camera_world.grad, s.T_camera_world))
    assert_same_vector(twists[0] - twists[1], torch.as_tensor(want), what="covariance twist")


def test_empty_field_renders_nothing(backend: Any) -> None:
    s = scene32("random", 0)
    none = replace(s, **{k: getattr(s, k)[:0] for k in ("means", "quats", "scales", "opacities", "features")})
    p, b = render(backend, none)
    assert [tuple(x.shape) for x in p] == [(0, 2), (0, 3), (0,), (0, 2)]
    assert tuple(b.sums.shape) == (SMALL.height, SMALL.width, 4)
    for image in (b.sums, b.moment, b.alpha, b.median_weight, b.dominant_weight):
        assert torch.count_nonzero(image) == 0
    assert bool((b.median_id == -1).all()) and bool((b.dominant_id == -1).all())


@pytest.mark.parametrize("kind", ["near_plane", "off_screen"])
def test_culled_splats_contribute_nothing_and_feel_nothing(backend: Any, kind: str) -> None:
    s = scene(kind, 2 * COUNT, SMALL).to(torch.float32)
    seen = torch.as_tensor(depths(s.to(torch.float64)) > s.options.near_m)
    assert 0 < int(seen.sum()) < len(seen)
    leaves = s.requiring_grad()
    p, b = render(backend, leaves)
    assert torch.equal(p.radii[:, 0] > 0, seen)
    front = replace(s, **{k: getattr(s, k)[seen] for k in ("means", "quats", "scales", "opacities", "features")})
    assert_same_maps(b, render(backend, front)[1], 1e-6)
    probe(b.sums, b.moment, b.alpha, p.z, p.means2d, p.conics).backward()
    for name in ("means", "quats", "scales", "opacities", "features"):
        gradient = getattr(leaves, name).grad
        assert torch.isfinite(gradient).all() and torch.count_nonzero(gradient[~seen]) == 0, name
