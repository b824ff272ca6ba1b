"""Hold the pose gradient, with and without the path through the covariance, to finite differences (CG-SLAM §2.1)."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from native_double import project_double
from paper_settings import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.data.harmonics import view_colors
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.mapping_step import TorchStep, ViewDependentStep
from sigmasplat.fit.target import Target
from sigmasplat.render import Render, reference, render
from sigmasplat.render.kernels import features_of, view_params
from splat_fields import exact_view, params_of, plane_gradients
from splat_scenes import SMALL, Scene, assert_same_vector, probe, scene, twist_differences, twist_gradient

PATHS = ("mean", "covariance", "depth", "color")
Moves = tuple[bool, ...]
ALL: Moves = (True, True, True, True)
FROZEN: Moves = (True, False, True, True)
"""The covariance stays as it is."""
CHOICES = (ALL, FROZEN)
STEP = 3e-7


def named(moves: Moves) -> str:
    return "+".join(path for path, on in zip(PATHS, moves, strict=True) if on)


def options_of(moves: Moves) -> RenderConfig:
    return RenderConfig(covariance_pose_gradient=moves[PATHS.index("covariance")])


def shiny(s: Scene, dtype: torch.dtype = torch.float64) -> GaussianField:
    """Make a scene's field with harmonics."""
    params = params_of(s)
    k = torch.as_tensor(np.random.default_rng(8).normal(0, 0.2, (len(params), 45))).float()
    return GaussianField(params.to(dtype), steps=1, attributes={"harmonics": Rows(k.to(dtype))})


def loss_of(seen: Render) -> Tensor:
    """Reduce all that a loss of a pose may read: colour, depth, alpha, V, U, median depth."""
    assert seen.uncertainty is not None
    return probe(seen.color, seen.depth, seen.alpha, seen.variance, seen.uncertainty, seen.median_depth)


def gradient(s: Scene, moves: Moves, dtype: torch.dtype = torch.float64, backend: str = "reference") -> Tensor:
    """Differentiate the loss of a render by the twist [6], with some paths on."""
    T = s.T_camera_world.to(dtype).clone().requires_grad_()
    loss = loss_of(render(shiny(s, dtype), s.camera, T, s.ref_depth.to(dtype), options_of(moves), backend))
    return twist_of(loss, T)


def twist_of(loss: Tensor, T: Tensor) -> Tensor:
    """Differentiate by the twist [6] of a pose; 0 where the loss does not feel it."""
    if not loss.requires_grad:
        return torch.zeros(6, dtype=torch.float64)
    (on_matrix,) = torch.autograd.grad(loss, T)
    return twist_gradient(on_matrix, T.detach())


def composed(s: Scene, T_mean: Tensor, T_covariance: Tensor, T_depth: Tensor, T_color: Tensor) -> float:
    """Evaluate the same loss with each path fed by a pose of its own, out of the two operators."""
    f = shiny(s)
    means2d, conics, z = (
        reference.project(f.means, f.quats, f.scales, T, s.camera, s.options)[k]
        for k, T in enumerate((T_mean, T_covariance, T_depth))
    )
    radii = reference.project(f.means, f.quats, f.scales, s.T_camera_world, s.camera, s.options).radii
    position = torch.as_tensor(se3.inverse(T_color.numpy())[:3, 3])
    colors = view_colors(f.colors, f.attributes["harmonics"].params, f.means, position)
    features = features_of(colors, z, f.variances)
    b = reference.blend(means2d, conics, z, radii, f.opacities, features, s.ref_depth, s.camera, s.options)
    median = torch.where(b.median_id >= 0, z[b.median_id.clamp(min=0).long()], 0.0)
    variance = b.sums[..., 4:7] - b.sums[..., :3] ** 2
    assert b.moment is not None
    return float(probe(b.sums[..., :3], b.sums[..., 3], b.alpha, variance, b.moment, median))


def differences(s: Scene, moves: Moves) -> Tensor:
    """Differentiate by the twist of exp(ξ)·T, moving the chosen paths only."""
    T_now = s.T_camera_world
    return twist_differences(lambda T: composed(s, *(T if on else T_now for on in moves)), T_now, STEP)


@pytest.mark.parametrize("kind", ["random", "off_screen"])
def test_the_whole_gradient_equals_differences_of_the_render(kind: str) -> None:
    """Nothing is composed here: the render itself is asked at poses ahead and behind."""
    s = scene(kind, 7, SMALL, 1e-3)
    found = twist_differences(
        lambda T: loss_of(render(shiny(s), s.camera, T, s.ref_depth, backend="reference")), s.T_camera_world, STEP
    )
    assert_same_vector(gradient(s, ALL), found, 1e-6, kind)


@pytest.mark.parametrize("moves", CHOICES, ids=named)
@pytest.mark.parametrize("kind", ["random", "off_screen"])
def test_a_path_that_is_off_is_frozen(kind: str, moves: Moves) -> None:
    s = scene(kind, 7, SMALL, 1e-3)
    assert_same_vector(gradient(s, moves), differences(s, moves), 1e-6, f"{kind} {named(moves)}")


@pytest.mark.parametrize("path", PATHS)
def test_every_path_matters(path: str) -> None:
    """What a path adds, by differences, is a part of the whole gradient, and that of the covariance is what the switch
    leaves out."""
    s = scene("random", 7, SMALL, 1e-3)
    added, whole = differences(s, tuple(name == path for name in PATHS)), gradient(s, ALL)
    assert float(added.norm()) > 1e-3 * float(whole.norm())
    if path == "covariance":
        assert_same_vector(whole - gradient(s, FROZEN), added, 1e-6, path)


@pytest.mark.parametrize("moves", CHOICES, ids=named)
@pytest.mark.parametrize("kind", ["random", "needles"])
def test_kernels_agree(kind: str, moves: Moves) -> None:
    pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    s = scene(kind, 40)
    assert_same_vector(gradient(s, moves, torch.float32, "cpu"), gradient(s, moves), 2e-4, f"{kind} {named(moves)}")


def test_a_covariance_that_is_off_leaves_the_fields_gradient_complete() -> None:
    s, found = scene("random", 12, SMALL), []
    for moves in CHOICES:
        field = shiny(s)
        leaves = [field.params.requires_grad_(), field.attributes["harmonics"].params.requires_grad_()]
        T = s.T_camera_world.clone().requires_grad_()
        seen = render(field, s.camera, T, s.ref_depth, options_of(moves), "reference")
        found.append(torch.autograd.grad(loss_of(seen), leaves))
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


@pytest.mark.parametrize("moves", CHOICES, ids=named)
def test_a_mapping_step_honours_the_switches(moves: Moves) -> None:
    """The step that adds the direction's path by hand returns the twist that autograd finds through `render`."""
    s, view = scene("random", 12, SMALL), exact_view(SMALL, True)
    view.options = options_of(moves)
    step, field = ViewDependentStep(TorchStep(view), 3), shiny(s)
    nothing = Target(SMALL, torch.zeros(3, *view.alpha.shape), torch.zeros(view.alpha.shape), 0)
    step.forward(field, s.T_camera_world.numpy(), nothing, {})
    view.g_sums[:] = plane_gradients(SMALL, len(view.sums))[0]
    twist, _ = step.splats(field, Rates(torch.full((17,), 1e-3, dtype=torch.float64)), {}, 0)

    T = s.T_camera_world.clone().requires_grad_()
    seen = render(shiny(s), SMALL, T, options=options_of(moves), backend="reference")
    sums = torch.cat([seen.color, seen.depth[..., None], seen.variance + seen.color**2], -1)
    want = twist_of((sums * view.g_sums.movedim(0, -1)).sum(), T)
    assert_same_vector(torch.as_tensor(twist), want, 1e-9, named(moves))


# ---- round splats ----


def round_ones(s: Scene) -> Scene:
    return replace(s, scales=s.scales[:, :1].expand(-1, 3).contiguous())


def in_front(s: Scene) -> tuple[Scene, Tensor]:
    """Keep the splats before the camera, its rotation exact in double; return them and their positions there [N, 3]."""
    s = replace(s, T_camera_world=torch.as_tensor(se3.orthonormalise(s.T_camera_world.numpy())))
    p = s.means @ s.T_camera_world[:3, :3].T + s.T_camera_world[:3, 3]
    front = p[:, 2] > 1.05 * s.options.near_m
    return replace(s, **{name: getattr(s, name)[front] for name in ("means", "quats", "scales")}), p[front]


def turns_by_reference(s: Scene, p: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
    """Split each splat's ∂(g·conics)/∂φ [N, 3] through the covariance: what turns R with J held, and what moves J.

    Moving the camera by ρ moves p alone, ∂/∂ρ = h; turning it by φ moves p by φ × p and R besides: the rest is R's.
    """
    twists = []
    for i in range(len(s.means)):
        T = s.T_camera_world.clone().requires_grad_()
        one = (x[i : i + 1] for x in (s.means, s.quats, s.scales))
        conics = reference.project(*one, T, s.camera, s.options).conics
        twists.append(twist_of((g[i] * conics).sum(), T))
    twist = torch.stack(twists)
    by_position = torch.linalg.cross(p, twist[:, :3])
    return twist[:, 3:] - by_position, by_position


def turns_by_kernels(s: Scene, p: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
    """Do the same by the kernels' own arithmetic, compiled in double."""
    numbers = view_params(s.camera, s.T_camera_world.numpy(), s.options, np.float64)
    on_conics = np.concatenate([np.zeros((len(p), 3)), g.numpy(), np.zeros((len(p), 2))], 1)
    _, out = project_double(numbers, s.means.numpy(), s.quats.numpy(), s.scales.numpy(), on_conics)
    twist = torch.as_tensor(out[:, 10:])
    by_position = torch.linalg.cross(p, twist[:, :3])
    return twist[:, 3:] - by_position, by_position


@pytest.mark.parametrize("turns", [turns_by_reference, turns_by_kernels], ids=["reference", "kernels"])
@pytest.mark.parametrize("kind", ["random", "huge", "off_screen"])
def test_a_round_splats_covariance_feels_no_rotation(kind: str, turns: object) -> None:
    """The isotropic identity: for Σ = s²I, X is symmetric and the covariance-rotation term 0, splat by splat."""
    assert callable(turns)
    s, p = in_front(scene(kind, 30))
    g = torch.as_tensor(np.random.default_rng(4).normal(size=(len(p), 3)))
    turn, by_position = turns(round_ones(s), p, g)
    assert float((turn.norm(dim=1) / by_position.norm(dim=1)).max()) < 1e-12
    turn, by_position = turns(s, p, g)
    assert float((turn.norm(dim=1) / by_position.norm(dim=1)).min()) > 1e-3, "every stretched splat feels it"


def test_a_round_splats_image_stays_when_its_axes_turn() -> None:
    """The same without a gradient: J held, any rotation in place of R leaves J R Σ Rᵀ Jᵀ of a round splat as it is."""
    s, p = in_front(scene("random", 30))
    J = torch.as_tensor(np.random.default_rng(5).normal(size=(len(p), 2, 3)))
    turn = torch.as_tensor(se3.exp(np.array([0, 0, 0, 0.7, -0.4, 1.1]))[:3, :3]) @ s.T_camera_world[:3, :3]

    def image(scales: Tensor, R: Tensor) -> Tensor:
        A = J @ R @ (reference.rotations(s.quats) * scales[:, None, :])
        return A @ A.mT

    for scales, least, most in ((round_ones(s).scales, 0.0, 1e-14), (s.scales, 1e-3, np.inf)):
        before, after = image(scales, s.T_camera_world[:3, :3]), image(scales, turn)
        change = (after - before).flatten(1).norm(dim=1) / before.flatten(1).norm(dim=1)
        assert float(change.min()) >= least and float(change.max()) < most
