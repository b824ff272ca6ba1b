"""fit_pose: move one camera, the field fixed. By the papers' Adam through the renderer, or by aligning images."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.align import LUMA, Pyramid, align
from sigmasplat.fit.confidence import outlier_mask, uncertainty_weights
from sigmasplat.fit.target import Target
from sigmasplat.model import se3
from sigmasplat.render.pose_gradient import pose_gradient
from sigmasplat.render.render import variance_of
from sigmasplat.render.view import View

Matrix = NDArray[np.float64]
ALIGN_ALPHA = 0.95
"""Align only where the map is this opaque: there C/A and D/A are the surface's own."""


@dataclass(eq=False)
class PoseFit:
    """T_camera_world; agreement: share of pixels seen by both map and sensor whose depths agree; overlap: share of
    sensor readings where the map has a surface; first and last loss; iterations; covariance [6, 6] of the left twist or
    None; exposure (a, b) of exp(a)·Ĉ + b."""

    T_camera_world: Matrix
    agreement: float
    overlap: float
    first_loss: float
    loss: float
    iterations: int
    covariance: Matrix | None = None
    exposure: tuple[float, float] = (0.0, 0.0)


@dataclass(eq=False)
class PoseMaps:
    """A render of the map laid beside a target: what both pose fits and the tracker's judgement read."""

    color: Tensor
    depth: Tensor
    alpha: Tensor
    variance: Tensor | None

    @staticmethod
    def of(view: View) -> "PoseMaps":
        h, w = view.camera.height, view.camera.width
        sums = view.sums[:, :h, :w].movedim(0, -1)
        variance = variance_of(sums) if sums.shape[-1] == 7 else None
        return PoseMaps(sums[..., :3], sums[..., 3], view.alpha[:h, :w], variance)


def agreement(maps: PoseMaps, target: Target) -> tuple[float, float]:
    """Measure how well a render explains a depth image: (share of common pixels within 5 % or 5 cm, common share)."""
    common = (maps.alpha > 0.5) & (target.depth_image > 0)
    surface = maps.depth / maps.alpha.clamp(min=0.5)
    close = (surface - target.depth_image).abs() < (0.05 * target.depth_image).clamp(min=0.05)
    n = int(common.sum())
    return float((close & common).sum()) / max(n, 1), n / max(target.valid_pixels, 1)


def pixel_weights(maps: PoseMaps, target: Target, config: TrackingConfig) -> tuple[Tensor, Tensor]:
    """Return (A³·M [H, W], w̃ [H, W, 3]) of VarSplat §3, both stop-gradient."""
    valid = target.depth_image > 0
    if config.alpha_above > 0:
        valid = valid & (maps.alpha > config.alpha_above)
    mask = outlier_mask(maps.depth - target.depth_image, valid, config.outlier_factor)
    soft = maps.alpha.clamp(min=0.0) ** config.alpha_power * mask
    if not config.uncertainty or maps.variance is None:
        return soft, torch.ones_like(maps.color)
    return soft, uncertainty_weights(maps.variance, mask, config.tau, config.weight_max)


def tracking_gradient(view: View, target: Target, config: TrackingConfig, exposure: Tensor) -> tuple[float, Tensor]:
    """Write ∂L_track/∂(color, depth) to the view's planes; return the loss and its gradient by exposure (a, b).

    L_track = Σ A³ M (λ_c w̃ |exp(a) Ĉ + b − C| + (1 − λ_c) |D̂ − D|), here a mean over pixels (VarSplat §3).
    """
    maps = PoseMaps.of(view)
    soft, weights = pixel_weights(maps, target, config)
    count = soft.numel()
    gain, offset = exposure[0].exp(), exposure[1]
    color_error = gain * maps.color + offset - target.image
    depth_error = maps.depth - target.depth_image
    on_color = config.weight_color / count * soft[..., None] * weights
    on_depth = (1.0 - config.weight_color) / count * soft
    g_color = on_color * color_error.sign()
    h, w = soft.shape
    view.g_sums.zero_()
    view.g_sums[:3, :h, :w] = (gain * g_color).movedim(-1, 0)
    view.g_sums[3, :h, :w] = on_depth * depth_error.sign()
    loss = (on_color * color_error.abs()).sum() + (on_depth * depth_error.abs()).sum()
    g_exposure = torch.stack([(g_color * gain * maps.color).sum(), g_color.sum()])
    return float(loss), g_exposure


def fit_pose_adam(
    params: Tensor, view: View, target: Target, T_camera_world: Matrix, config: TrackingConfig, iterations: int
) -> PoseFit:
    """Descend L_track by Adam over a unit quaternion and a translation after the first guess; the best iterate wins.

    params [N, 17] and σ² are frozen (VarSplat §3). Raises nothing: without common pixels the guess comes back.
    """
    motion = torch.tensor([1.0, 0, 0, 0, 0, 0, 0], dtype=torch.float64, requires_grad=True)
    exposure = torch.zeros(2, requires_grad=True)
    groups = [
        {"params": [motion], "lr": 1.0},
        {"params": [exposure], "lr": config.lr_exposure if config.exposure else 0.0},
    ]
    optimiser = torch.optim.Adam(groups)
    # One Adam with two step sizes: the translation is measured in units that make one rate serve both.
    unit = torch.tensor([config.lr_rotation] * 4 + [config.lr_translation] * 3, dtype=torch.float64)
    start = torch.tensor([1.0, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
    best, best_T, best_exposure, first, previous = np.inf, T_camera_world, (0.0, 0.0), np.inf, np.inf
    steps = 0
    for steps in range(1, iterations + 1):
        T = _motion(start + (motion - start) * unit) @ torch.as_tensor(T_camera_world)
        pose = T.detach().numpy()
        view.forward(params, pose)
        loss, g_exposure = tracking_gradient(view, target, config, exposure.detach())
        first = loss if steps == 1 else first
        if loss < best:
            best, best_T, best_exposure = loss, pose.copy(), tuple(exposure.detach().tolist())
        twist = view.backward(params, None)
        optimiser.zero_grad()
        T.backward(pose_gradient(T, twist))  # type: ignore[no-untyped-call]
        exposure.grad = g_exposure
        before = motion.detach().clone()
        optimiser.step()
        moved = ((motion.detach() - before) * unit).abs().max()
        if config.update_stop > 0 and float(moved) < config.update_stop and abs(loss - previous) < 1e-4 * previous:
            break
        previous = loss
    view.forward(params, best_T)
    agree, overlap = agreement(PoseMaps.of(view), target)
    T_best = se3.orthonormalise(best_T)
    return PoseFit(T_best, agree, overlap, first, best, steps, exposure=best_exposure)


def _motion(quaternion_translation: Tensor) -> Tensor:
    """Build the 4×4 motion of (w, x, y, z, tx, ty, tz), the quaternion normalised; differentiable."""
    q = quaternion_translation[:4] / quaternion_translation[:4].norm()
    w, x, y, z = q
    t = quaternion_translation[4:]
    zero, one = torch.zeros_like(w), torch.ones_like(w)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), t[0]],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), t[1]],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), t[2]],
        [zero, zero, zero, one],
    ]
    return torch.stack([torch.stack(row) for row in rows])


@dataclass(eq=False)
class Reference:
    """An image with depth and pixel weights to align others to, and where it was seen from, T_camera_world [4, 4]."""

    pyramid: Pyramid
    T_camera_world: Matrix


def fit_pose_align(reference: Reference, live: Pyramid, T_camera_world: Matrix, config: TrackingConfig) -> PoseFit:
    """Align the live image to a reference by Gauss–Newton (`fit.align`), from a first guess."""
    guess = T_camera_world @ se3.inverse(reference.T_camera_world)
    found = align(reference.pyramid, live, guess, config.align_iterations, config.align_weight_color, config.align_stop)
    return PoseFit(
        found.T_live_reference @ reference.T_camera_world,
        found.agreement,
        found.overlap,
        float("nan"),
        found.cost,
        found.steps,
        covariance=found.covariance,
    )


def map_reference(params: Tensor, view: View, T_camera_world: Matrix, config: TrackingConfig) -> Reference:
    """Render the map as a reference: gray C/A and depth D/A where it is opaque, weighed by w̃ (VarSplat §3)."""
    view.forward(params, T_camera_world)
    maps = PoseMaps.of(view)
    opaque = maps.alpha > ALIGN_ALPHA
    divisor = maps.alpha.clamp(min=0.5)
    gray = (maps.color @ torch.from_numpy(LUMA)) / divisor
    surface = torch.where(opaque, maps.depth / divisor, 0.0)
    pyramid = Pyramid.of(gray.numpy(), surface.numpy(), view.camera, _confidence(maps, opaque, config))
    return Reference(pyramid, T_camera_world)


def keyframe_reference(
    params: Tensor, view: View, image: Pyramid, T_camera_world: Matrix, config: TrackingConfig
) -> Reference:
    """Take a keyframe's own image as a reference, each pixel weighed by w̃ of the map seen from there (VarSplat §3).

    The sensor's surface is unbiased where a young map still renders too near; the map says which pixels to trust.
    """
    if not config.uncertainty:
        return Reference(image, T_camera_world)
    view.forward(params, T_camera_world)
    maps = PoseMaps.of(view)
    weight = _confidence(maps, maps.alpha > ALIGN_ALPHA, config)
    return Reference(Pyramid.of(image.gray[0], image.depth[0], view.camera, weight), T_camera_world)


def _confidence(maps: PoseMaps, opaque: Tensor, config: TrackingConfig) -> NDArray[np.float32] | None:
    """Average w̃ over the channels, [H, W]; where the map is thin, V says nothing and the weight is 1."""
    if not config.uncertainty or maps.variance is None:
        return None
    weight = uncertainty_weights(maps.variance, opaque, config.tau, config.weight_max).mean(-1)
    return np.asarray(torch.where(opaque, weight, 1.0).numpy())
