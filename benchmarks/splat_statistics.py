"""Compute what the training views tell about each splat: values per splat whose rendering predicts squared errors.

Each statistic is one function in `STATISTICS`; it returns named values [N]. All read training views only.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.fit.target import Keyframe
from sigmasplat.render import FieldRenderer, Render
from sigmasplat.render.backend import on_device
from sigmasplat.types import Matrix
from sigmasplat.uncertainty.calibration import squared_errors
from sigmasplat.uncertainty.map_uncertainty import MapUncertainty
from sigmasplat.uncertainty.predictive import BlendedValues, blend_values

GRADIENT_STEPS = 6
"""Steps of conjugate gradients for the ridge regression."""
RIDGE = 1.0
"""λ of the ridge regression, in pixels: the squared weights of a splat must sum to more to count."""
PROBES_SEED = 17
SIGN_PLANES = 3
"""Planes of random signs for each view."""


@dataclass(frozen=True, eq=False)
class TrainingView:
    """A keyframe at its pose in a map: squared residuals of colour (mean over channels) and depth, [H, W].

    depth_known [H, W]: 1 where the keyframe has a reading and the map covers the pixel, else 0.
    """

    T_camera_map: Matrix
    color_error2: Tensor
    depth_error2: Tensor
    depth_known: Tensor


@dataclass(frozen=True, eq=False)
class MapFacts:
    """A map and its training views, all with one camera.

    noise: mean squared residual of colour and depth (m²); prior: variance of the colours (mean over channels) and of
    the depths (m²) of the training views; mean_color [3] of them; uncertainty: what the
    run itself knows of its map, if it does.
    """

    field: GaussianField
    camera: Camera
    views: Sequence[TrainingView]
    noise: tuple[float, float]
    prior: tuple[float, float]
    mean_color: Tensor
    renderer: FieldRenderer
    uncertainty: MapUncertainty | None = None

    @cached_property
    def on_device(self) -> GaussianField:
        """Return the map in memory that the backend can read."""
        return on_device(self.field, self.renderer.backend)

    def blended(self, T_camera_map: Matrix, values: Tensor, gather: bool = False) -> BlendedValues:
        """Blend values [N, K] of the splats at a pose; gather: as in `blend_values`."""
        settings = self.renderer.options, self.renderer.backend
        return blend_values(self.on_device, self.camera, T_camera_map, values, *settings, gather=gather)

    def rendered(self, T_camera_map: Matrix, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Render values [N] by name to planes [H, W], Σ_i w_ip v_i."""
        planes = self.blended(T_camera_map, torch.stack(list(values.values()), 1)).values.cpu()
        return dict(zip(values, planes.unbind(-1), strict=True))


def map_facts(field: GaussianField, keyframes: Sequence[Keyframe], renderer: FieldRenderer) -> MapFacts:
    """Render a map at keyframes (poses in the map's frame) and collect their residuals."""
    views, colors, depths = list[TrainingView](), list[Tensor](), list[Tensor]()
    for keyframe in keyframes:
        T_camera_map, target = se3.inverse(keyframe.T_world_camera), keyframe.target
        seen, depth = on_host(renderer(field, target.camera, T_camera_map)), target.depth_image
        errors, known = squared_errors(seen.color, seen.depth, seen.alpha, target.image, depth)
        views.append(TrainingView(T_camera_map, errors[..., 0], errors[..., 1], known[..., 1]))
        colors.append(target.image.reshape(-1, 3)[::7])
        depths.append(depth[depth > 0][::7])
    all_colors, all_depths = torch.cat(colors), torch.cat(depths)
    known_pixels = sum(float(v.depth_known.sum()) for v in views)
    noise = (
        sum(float(v.color_error2.mean()) for v in views) / len(views),
        sum(float(v.depth_error2.sum()) for v in views) / max(known_pixels, 1.0),
    )
    prior = (
        float(all_colors.var(0, correction=0).mean()),
        float(all_depths.var(correction=0)) if len(all_depths) else 1.0,
    )
    camera = keyframes[0].target.camera
    return MapFacts(field, camera, views, noise, prior, all_colors.mean(0), renderer)


def on_host(seen: Render) -> Render:
    """Return a render in host memory, where keyframes and statistics are."""
    return replace(seen, **{name: plane.detach().cpu() for name, plane in vars(seen).items() if plane is not None})


def ridge(facts: MapFacts) -> dict[str, Tensor]:
    """Regress squared training residuals onto splats (3DGS-U, arXiv 2603.22786).

    Returns u ≥ 0 [N] for colour and depth that minimise Σ_p (Σ_i w_ip u_i − r_p²)² + λ Σ_i u_i², by a few steps of
    conjugate gradients from the weighted mean of each splat; negative values become 0 at the end. readings [N]: the
    weight Σ_p w_ip of each splat in pixels with a reading of depth.
    """
    known = [torch.stack([torch.ones_like(v.depth_known), v.depth_known], -1) for v in facts.views]
    errors = [torch.stack([v.color_error2, v.depth_error2], -1) for v in facts.views]
    nothing = torch.zeros(len(facts.field), 0)
    weights, wanted = torch.zeros(2, len(facts.field), 2)
    for v, k, e in zip(facts.views, known, errors, strict=True):
        sums = facts.blended(v.T_camera_map, nothing, gather=True).gather(torch.cat([k, e], -1)).cpu()
        weights += sums[:, :2]
        wanted += sums[:, 2:]

    def normal(x: Tensor) -> Tensor:
        total = RIDGE * x
        for v, k in zip(facts.views, known, strict=True):
            seen = facts.blended(v.T_camera_map, x, gather=True)
            total += seen.gather(k.to(seen.values) * seen.values).cpu()
        return total

    x = wanted / (weights + RIDGE)
    residual = wanted - normal(x)
    direction, size = residual.clone(), residual.square().sum(0)
    for _ in range(GRADIENT_STEPS):
        applied = normal(direction)
        step = size / (direction * applied).sum(0).clamp(min=1e-30)
        x = x + step * direction
        residual = residual - step * applied
        before, size = size, residual.square().sum(0)
        direction = residual + size / before.clamp(min=1e-30) * direction
    return {"ridge_color": x[:, 0].clamp(min=0.0), "ridge_depth": x[:, 1].clamp(min=0.0), "readings": weights[:, 1]}


def fisher(facts: MapFacts) -> dict[str, Tensor]:
    """Return the variance [N] of each splat's colour and depth from the Laplace approximation (FisherRF, 2311.17874).

    The Hessian's diagonal of colour is H_i = Σ_p w_ip² over the training views, and the variance is
    1/(H_i/noise + 1/prior). Random signs g estimate it without bias: E (Σ_p w_ip g_p)² = Σ_p w_ip². The depth of a
    pixel depends on the splats' depths with the same weights.
    """
    numbers = torch.Generator().manual_seed(PROBES_SEED)
    information = torch.zeros(len(facts.field))
    for v in facts.views:
        signs = 2.0 * torch.randint(0, 2, (SIGN_PLANES, *v.color_error2.shape), generator=numbers).float() - 1.0
        planes = signs.movedim(0, -1)
        sums = facts.blended(v.T_camera_map, torch.zeros(len(facts.field), 0), gather=True).gather(planes).cpu()
        information += sums.square().mean(1)
    return {
        f"fisher_{name}": 1.0 / (information / max(noise, 1e-12) + 1.0 / max(prior, 1e-12))
        for name, noise, prior in zip(("color", "depth"), facts.noise, facts.prior, strict=True)
    }


STATISTICS: tuple[Callable[[MapFacts], dict[str, Tensor]], ...] = (ridge, fisher)
"""Functions from the training views of a map to named values of its splats."""


def splat_values(facts: MapFacts) -> dict[str, Tensor]:
    """Return the values [N] of all statistics by name."""
    return {name: values for statistic in STATISTICS for name, values in statistic(facts).items()}
