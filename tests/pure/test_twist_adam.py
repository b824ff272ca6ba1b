"""Adam on a pose: its numbers are torch's, its direction is downhill, and a fixed keyframe stays."""

import numpy as np
import torch
from numpy.typing import NDArray

from paper_settings import MappingConfig, RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.fit.adam import BETA1, BETA2, EPSILON, VectorAdam, VectorAmsgrad
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.render.reference import ReferenceView

Array = NDArray[np.float64]
RATES = np.repeat([2e-3, 5e-3], 3)
CAMERA = Camera(8, 6, 8.0, 8.0, 3.5, 2.5)
POINTS = np.random.default_rng(0).normal(size=(40, 3))
"""All round the camera, so that turning and shifting are told apart."""
TRUTH = se3.exp(np.array([0.2, -0.1, 0.3, 0.1, 0.4, -0.2]))


def keyframe(T_world_camera: Array) -> Keyframe:
    frame = Frame(0, 0.0, np.full((6, 8, 3), 0.5, np.float32), np.full((6, 8), 2.0, np.float32), CAMERA)
    return Keyframe(0, Target.of(frame, (6, 8)), T_world_camera)


def loss(T_world_camera: Array) -> float:
    """Measure how far a pose puts points from where the true one does, in the camera."""
    T, true = se3.inverse(T_world_camera), se3.inverse(TRUTH)
    off = (T[:3, :3] - true[:3, :3]) @ POINTS.T + (T[:3, 3:] - true[:3, 3:])
    return float((off**2).sum(0).mean())


def gradient(T_world_camera: Array) -> Array:
    """Differentiate by the left twist of T_camera_world, as the renderer's backward pass does."""
    T = se3.inverse(T_world_camera)
    steps = 1e-6 * np.eye(6)
    return np.array([loss(se3.inverse(se3.exp(e) @ T)) - loss(se3.inverse(se3.exp(-e) @ T)) for e in steps]) / 2e-6


def test_updates_are_those_of_torch() -> None:
    gradients = np.random.default_rng(1).normal(size=(40, 6)) * np.geomspace(1e-6, 10.0, 6)
    gradients[5:9] = 0.0  # unseen for a while: it coasts
    halves = [torch.zeros(3, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    groups = [{"params": [half], "lr": rate} for half, rate in zip(halves, (RATES[0], RATES[3]), strict=True)]
    theirs, ours, position = torch.optim.Adam(groups, betas=(BETA1, BETA2), eps=EPSILON), VectorAdam.of(6), np.zeros(6)
    for g in gradients:
        for half, part in zip(halves, np.split(g, 2), strict=True):
            half.grad = torch.tensor(part)
        theirs.step()
        position += ours.step(g, RATES)
        np.testing.assert_allclose(position, torch.cat(halves).detach().numpy(), rtol=1e-10, atol=1e-15)
    assert ours.steps == 40


def test_updates_with_the_largest_moment_are_those_of_torch() -> None:
    random = np.random.default_rng(3)
    gradients = random.normal(size=(20, 6)) * np.geomspace(1.0, 1e-3, 20)[:, None]  # so that the largest moment matters
    numbers = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    theirs = torch.optim.Adam([numbers], lr=RATES[0], betas=(BETA1, BETA2), eps=EPSILON, amsgrad=True)
    ours, plain, at, at_plain = VectorAmsgrad.of(6), VectorAdam.of(6), np.zeros(6), np.zeros(6)
    for gradient in gradients:
        numbers.grad = torch.as_tensor(gradient)
        theirs.step()
        at += ours.step(gradient, np.full(6, RATES[0]))
        at_plain += plain.step(gradient, np.full(6, RATES[0]))
        np.testing.assert_allclose(at, numbers.detach().numpy(), rtol=1e-9)
    assert np.abs(at - at_plain).max() > 1e-6


def test_a_step_is_as_long_as_its_rate_whatever_the_gradients_size() -> None:
    g = np.array([1e-7, -1.0, 1e4, 3.0, -1e-5, 2.0])
    np.testing.assert_allclose(VectorAdam.of(6).step(g, RATES), -RATES * np.sign(g), rtol=1e-6)


def test_a_keyframe_moves_against_its_gradient() -> None:
    """One axis at a time: a sign error in translation or rotation, or the wrong side of the pose, shows here."""
    for axis in range(6):
        twist = np.zeros(6)
        twist[axis] = 0.05
        moved = keyframe(TRUTH @ se3.exp(twist))  # off in the camera's own axes
        before = loss(moved.T_world_camera)
        moved.move(gradient(moved.T_world_camera), np.full(6, 1e-3))
        assert loss(moved.T_world_camera) < before


def test_a_keyframe_walks_down_to_the_truth() -> None:
    moved = keyframe(TRUTH @ se3.exp(np.array([0.05, -0.04, 0.06, 0.03, -0.02, 0.04])))
    far = loss(moved.T_world_camera)
    for i in range(500):
        moved.move(gradient(moved.T_world_camera), np.full(6, 4e-3 * 0.99**i))
    assert loss(moved.T_world_camera) < 1e-4 * far
    assert se3.is_rigid(moved.T_world_camera, 1e-9)
    np.testing.assert_allclose(moved.T_world_camera, TRUTH, atol=1e-3)


def test_a_rate_of_zero_holds_its_half() -> None:
    moved = keyframe(np.eye(4))
    moved.move(np.ones(6), np.array([1e-3, 1e-3, 1e-3, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(moved.T_world_camera[:3, :3], np.eye(3), atol=1e-15)
    np.testing.assert_allclose(moved.T_world_camera[:3, 3], 1e-3, rtol=1e-9)


def fitted(fixed: bool, **rates: float) -> Keyframe:
    """Fit a wall of splats to a keyframe that stands off its place; return the keyframe."""
    rng = np.random.default_rng(2)
    means = np.concatenate([rng.uniform(-1, 1, (60, 2)), np.full((60, 1), 2.0)], 1)
    values = [torch.as_tensor(x, dtype=torch.float32) for x in (means, np.full(60, 0.15), rng.random((60, 3)))]
    field, view = GaussianField.from_values(*values, opacities=0.9), ReferenceView(CAMERA, RenderConfig())
    view.forward(field.params, np.eye(4))
    color = view.sums[:3].movedim(0, -1).clamp(0, 1).numpy().copy()
    frame = Frame(0, 0.0, color, np.full((6, 8), 2.0, np.float32), CAMERA)
    stands = se3.exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]))
    seen = Keyframe(0, Target.of(frame, (6, 8)), stands.copy(), fixed)
    fit_field(field, view, [[seen]] * 3, MappingConfig(**rates))
    return seen


def test_mapping_moves_keyframes_only_where_asked_and_never_a_fixed_one() -> None:
    stands, rates = se3.exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])), {"lr_pose_translation": 1e-3}
    free, fixed, unasked = fitted(False, **rates), fitted(True, **rates), fitted(False)
    assert 1e-4 < np.abs(free.T_world_camera - stands).max() < 0.01
    assert free.motion.steps == 3
    for still in (fixed, unasked):
        np.testing.assert_array_equal(still.T_world_camera, stands)
        assert still.motion.steps == 0
