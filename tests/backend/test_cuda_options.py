"""Hold what a CUDA mapping step can do besides to its definitions in torch, float64, on the emulated kernels.

Several keyframes a step, colours that depend on the view; and who waits for whom.
"""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from paper_settings import MappingConfig
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.data.harmonics import count
from sigmasplat.errors import ConfigError
from sigmasplat.fit.backends import step_for
from sigmasplat.fit.field import fit_field, loss_weights
from sigmasplat.fit.interface import MappingStep
from sigmasplat.fit.mapping_step import GradientAccumulator, TorchStep, ViewDependentStep
from sigmasplat.fit.target import Keyframe
from sigmasplat.plugins.cuda.mapping_step import CudaAccumulator, CudaStep, CudaViewDependentStep, to_host
from sigmasplat.plugins.cuda.view import CudaView
from sigmasplat.render.cpu import CpuView
from sigmasplat.render.reference import ReferenceView
from sigmasplat.render.view import View
from splat_fields import (
    CPU,
    OPTIONS,
    Gradients,
    crowd,
    exact_view,
    params_of,
)
from splat_fits import RATES, fields, random_gradient, target_of
from splat_scenes import WIDE, Scene, assert_same_vector, scene

SHAPES = {"isotropy": 0.7, "isotropy_ratio": 0.01}


pytestmark = pytest.mark.usefixtures("on_the_cpu")


def turned(s: Scene, angle: float) -> np.ndarray:
    """Return T_camera_world of a scene, its camera turned."""
    return np.asarray(se3.exp(np.array([0, 0, 0, 0, angle, 0])) @ s.T_camera_world.numpy())


def pair_of_fields(n: int) -> tuple[GaussianField, GaussianField]:
    """Make a field and its double mid-run, its attributes too: some rows were moved last a while ago, some never."""
    pair, rng = fields(n), np.random.default_rng(7)
    drawn = [torch.as_tensor(rng.normal(0, s, (n, 45))) for s in (0.3, 1e-3, 1e-3)]
    last = torch.as_tensor(rng.choice([29, 29, 12, 0], n), dtype=torch.int32)
    for field in pair:
        params, moment1, moment2 = (x.to(field.params, copy=True) for x in drawn)
        field.attributes["harmonics"] = Rows(params, moment1, moment2.square(), last.clone(), 29)
    return pair


def assert_same_steps(got: Rows, want: Rows, start: Tensor, began: int, what: str) -> None:
    """Compare where Adam went, its moments, and whom it moved."""
    assert torch.equal(got.last_step, want.last_step) and got.steps == want.steps
    assert_same_vector(got.moment1, want.moment1, 1e-3, f"{what}: moment1")
    assert_same_vector(got.moment2, want.moment2, 1e-3, f"{what}: moment2")
    assert_same_vector(got.params - start.to(got.params), want.params - start, 5e-3, f"{what}: steps")
    waiting = want.last_step <= began
    assert torch.equal(got.params[waiting], start[waiting].to(got.params))


# ---- several keyframes a step


@pytest.mark.parametrize("n", [0, 7, 300])
def test_gathered_images_step_as_by_definition(n: int) -> None:
    """Three images, one of which shows nothing; pull, frozen colours, shape terms."""
    s, (got, want) = crowd(), fields(n)
    start, view, exact = want.params.clone(), CudaView(s.camera, OPTIONS, True, CPU), exact_view(s.camera, True)
    away = np.diag([-1.0, 1.0, -1.0, 1.0]) @ s.T_camera_world.numpy()
    for poses in ((turned(s, 0.7), away, turned(s, 0.8)), (turned(s, 0.6), turned(s, 0.5), away)):
        results: list[Any] = []
        for field, v, gathered in (
            (got, view, CudaAccumulator(view, got)),
            (want, exact, GradientAccumulator(exact, want)),
        ):
            field.steps += 1
            twists, pulls = [], []
            for k, T in enumerate(poses):
                v.forward(field.params, T)
                random_gradient(v, k)  # type: ignore[arg-type]
                pull = field.params.new_full((n,), torch.nan)
                twists.append(gathered.add(field, 1.0 / 3.0, pull))
                pulls.append(pull)
            here, (cost,) = to_host(twists, [gathered.step(field, RATES, SHAPES, n // 3)])
            results.append((np.stack(here), torch.stack(pulls), cost))
        (twist, pull, cost), (want_twist, want_pull, want_cost) = results
        assert cost == pytest.approx(want_cost, rel=1e-4)
        if n:
            assert_same_vector(torch.as_tensor(twist), torch.as_tensor(want_twist), 1e-3, "twists")
            assert_same_vector(pull, want_pull, 1e-3, "pull")
        assert not twist[[T is away for T in poses]].any()
    if n:
        assert_same_steps(got, want, start, 99, "rows")
    if n > 100:
        assert 5 < int((want.last_step <= 99).sum()) < n


# ---- colours that depend on the view


def view_dependent(s: Scene, degree: int) -> tuple[CudaViewDependentStep, ViewDependentStep]:
    view, exact = CudaView(s.camera, OPTIONS, True, CPU), exact_view(s.camera, True)
    return CudaViewDependentStep(CudaStep(view), degree), ViewDependentStep(TorchStep(exact), degree)


@pytest.mark.parametrize("n", [0, 7, 300])
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_step_of_shown_colours_follows_its_definition(degree: int, n: int) -> None:
    """Three steps with frozen colours, splats out of view and pull; degrees not in use are left alone."""
    s, (got, want) = crowd(), pair_of_fields(n)
    starts, (there, here) = (
        [want.params.clone(), want.attributes["harmonics"].params.clone()],
        view_dependent(s, degree),
    )
    target = target_of(s.camera, (s.camera.height, s.camera.width))
    for k, angle in enumerate((0.7, -0.5, 0.7)):
        results: list[Any] = []
        for field, step in ((got, there), (want, here)):
            field.steps += 1
            step.forward(field, turned(s, angle), target, {})
            random_gradient(step.view, k)  # type: ignore[arg-type]
            pull = field.params.new_full((n,), torch.nan)
            results.append((step.view.sums.clone(), pull, *step.splats(field, RATES, SHAPES, n // 3, pull)))
        (sums, pull, twist, cost), (want_sums, want_pull, want_twist, want_cost) = results
        assert float(cost) == pytest.approx(want_cost, rel=1e-4)
        if n:
            assert float((sums - want_sums).norm()) < 1e-3 * float(want_sums.norm())
            assert_same_vector(pull, want_pull, 1e-3, "pull")
            assert_same_vector(torch.as_tensor(twist), torch.as_tensor(want_twist), 1e-3, "twist")
    if n:
        harmonics, width = got.attributes["harmonics"], 3 * count(degree)
        assert_same_steps(got, want, starts[0], 99, "rows")
        assert_same_steps(harmonics, want.attributes["harmonics"], starts[1], 29, "harmonics")
        assert torch.equal(harmonics.params[:, width:], starts[1][:, width:].float())


def test_a_pose_feels_the_directions() -> None:
    s, twists = scene("random", 60), []
    for field, step in zip(pair_of_fields(60), view_dependent(s, 3), strict=True):
        field.params = params_of(s).to(field.params)
        field.steps += 1
        target = target_of(s.camera, (s.camera.height, s.camera.width))
        step.forward(field, s.T_camera_world.numpy(), target, {})
        random_gradient(step.view, 5)  # type: ignore[arg-type]
        twists.append(torch.as_tensor(step.splats(field, RATES, {}, 0)[0]))
        step.view.forward(step.rows, s.T_camera_world.numpy())
        plain = torch.as_tensor(step.view.backward(step.rows, torch.empty_like(field.params)))
        assert not torch.allclose(plain[:3], twists[-1][:3])
    assert_same_vector(*twists, 1e-3, "twist")


def test_a_splat_where_the_camera_is_has_no_direction() -> None:
    s = scene("random", 60)
    field = GaussianField(params_of(s), steps=1)
    T = s.T_camera_world.numpy()
    field.params[3, :3] = torch.as_tensor(-T[:3, :3].T @ T[:3, 3]).float()
    step, _ = view_dependent(s, 3)
    field.get_or_create("harmonics").params += 0.1
    target = target_of(s.camera, (s.camera.height, s.camera.width))
    step.forward(field, T, target, {})
    random_gradient(step.view, 1)  # type: ignore[arg-type]
    twist, _ = step.splats(field, RATES, SHAPES, 0)
    assert torch.isfinite(step.view.sums).all() and torch.isfinite(twist).all()
    assert torch.isfinite(field.params).all() and torch.isfinite(field.attributes["harmonics"].params).all()


# ---- whole fits


def fitted(
    view: View, config: MappingConfig, images: int, degree: int
) -> tuple[GaussianField, list[float], np.ndarray]:
    s = scene("random", 60)
    field, target = GaussianField(params_of(s)), target_of(s.camera, (view.alpha.shape[0], view.alpha.shape[1]))
    pose, stats = se3.inverse(s.T_camera_world.double().numpy()), Gradients()
    seen = [Keyframe(k, target, pose @ se3.exp(0.01 * k * np.ones(6))) for k in range(images)]
    fit = fit_field(field, view, [seen] * 3, config, frozen_colors=5, degree=degree, stats=stats)
    assert len(stats.given) == 3 * images and all(bool(grad2d.any()) for _, grad2d in stats.given)
    return field, fit.losses, np.stack([k.T_world_camera for k in seen])


@pytest.mark.parametrize(("images", "degree"), [(3, 0), (1, 1), (1, 2), (1, 3)])
def test_fits_are_those_of_the_cpu(images: int, degree: int) -> None:
    pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    config = MappingConfig(
        weight_nll_color=1e-2, weight_isotropy_ratio=0.1, lr_pose_translation=1e-3, lr_pose_rotation=1e-3,
        weight_alignment=0.3,
    )  # fmt: skip
    start = params_of(scene("random", 60))
    ours, losses, poses = fitted(CudaView(WIDE, OPTIONS, True, CPU), config, images, degree)
    theirs, wanted, wanted_poses = fitted(CpuView(WIDE, OPTIONS), config, images, degree)
    np.testing.assert_allclose(losses, wanted, rtol=1e-3)
    np.testing.assert_allclose(poses, wanted_poses, atol=1e-4)
    assert_same_vector(ours.params - start, theirs.params - start, 3e-2, "what Adam moved")
    assert sorted(ours.attributes) == sorted(theirs.attributes)
    for name, attribute in theirs.attributes.items():
        assert_same_vector(ours.attributes[name].params, attribute.params, 3e-2, name)


def test_each_device_has_its_step() -> None:
    view, plain = CudaView(WIDE, OPTIONS, True, CPU), loss_weights(MappingConfig())
    kinds: list[tuple[MappingStep, type, type]] = [
        (step_for(view, plain, 0), CudaStep, CudaView),
        (step_for(view, plain, 2), CudaViewDependentStep, CudaView),
        (step_for(ReferenceView(WIDE, OPTIONS), plain, 0), TorchStep, ReferenceView),
    ]
    for step, kind, seen in kinds:
        assert type(step) is kind and type(step.view) is seen


def test_several_keyframes_are_refused_as_on_the_cpu() -> None:
    with pytest.raises(ConfigError, match="a step on several keyframes needs"):
        fitted(CudaView(WIDE, OPTIONS, True, CPU), MappingConfig(weight_nll_color=1e-2), 2, degree=1)


def test_what_a_step_left_on_a_device_arrives_in_its_places() -> None:
    twists = [torch.arange(6.0), np.arange(6.0) + 10, torch.arange(6.0).double() + 20]
    here, numbers = to_host(twists, [torch.tensor(1.5), 2.5, torch.tensor(3.5, dtype=torch.float64)])
    assert [t.tolist() for t in here] == [[k + i for i in range(6)] for k in (0, 10, 20)] and numbers == [1.5, 2.5, 3.5]
    assert to_host([np.zeros(6)], [0.5])[1] == [0.5] and to_host([], []) == ([], [])
