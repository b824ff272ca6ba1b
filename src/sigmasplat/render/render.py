"""Render a field from a camera: two kernels, then formulas on their sums."""

from collections import deque
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.data.harmonics import view_colors
from sigmasplat.render.backend import backend_module, on_device
from sigmasplat.render.kernels import depth_at, depth_of, features_of, plane_features, variance_of
from sigmasplat.render.reference import depth_slopes

CENTER = RenderConfig(depth="center")
"""The options of a render if none are given: depths of centres, which every backend has."""


@dataclass(frozen=True, eq=False)
class Render:
    """The maps that a camera sees of a field, all [H, W] or [H, W, 3].

    color Ĉ = Σ w c; depth D̂ = Σ w z (m, not divided by alpha), with `render.depth=ray` z along the ray;
    alpha A = Σ w;
    variance V = Σ w (σ² + c²) − Ĉ², the law of total variance (VarSplat §1); uncertainty U = Σ w (z − D)² of the
    splats' centres about a reference depth D (m², CG-SLAM eq. 10), None without a reference; median_depth: z where half
    of the light is absorbed, 0 if it never is (CG-SLAM eq. 8); median_id, dominant_id: the splat at that depth, and the
    splat of largest weight, −1 = none.
    """

    color: Tensor
    depth: Tensor
    alpha: Tensor
    variance: Tensor
    uncertainty: Tensor | None
    median_depth: Tensor
    median_id: Tensor
    dominant_id: Tensor
    dominant_weight: Tensor


def colors_from(field: GaussianField, T_camera_world: Tensor, rows: Tensor | None = None) -> Tensor:
    """Return the colours [N, 3] that a camera sees, or those of some rows [n]."""
    params = field.params if rows is None else field.params[rows]
    colors = params[:, COLUMNS["colors"]]
    if "harmonics" not in field.attributes:
        return colors
    T, harmonics = T_camera_world.to(field.params), field.attributes["harmonics"].params
    position = -(T[:3, :3] * T[:3, 3:]).sum(0)
    return view_colors(colors, harmonics if rows is None else harmonics[rows], params[:, COLUMNS["means"]], position)


def render(
    field: GaussianField, camera: Camera, T_camera_world: Tensor | NDArray[np.floating],
    depth_reference: Tensor | None = None, options: RenderConfig | None = None, backend: str = "auto",
) -> Render:  # fmt: skip
    """Render a field at a pose (4×4, world to camera); differentiable in `field.params` and in a tensor pose.

    The pose gradient is the sum of the paths through 2D means, 2D covariances (unless `options` leaves them out),
    depths, and the viewing directions of `harmonics`. Raises BackendError if the backend is not available.
    """
    kernels, options = backend_module(backend, field.params.device), options or CENTER
    field = on_device(field, backend)
    T = torch.as_tensor(T_camera_world)
    p = kernels.project(field.means, field.quats, field.scales, T, camera, options)
    features = features_of(colors_from(field, T), p.z, field.variances)
    channels, rays = features.shape[1], options.depth == "ray" and len(field) > 0
    if rays:
        slopes = depth_slopes(field.means, field.quats, field.scales, T, camera, options)
        features = torch.cat([features, plane_features(p, slopes, camera)], 1)
    b = kernels.blend(*p, field.opacities, features, depth_reference, camera, options)
    sums, depth = b.sums[..., :channels], b.sums[..., 3]
    crossed, rows = b.median_id >= 0, b.median_id.clamp(min=0).long()
    nearest = p.z[rows] if len(field) else torch.zeros_like(b.alpha)
    if rays:
        depth, nearest = depth_of(b.sums[..., channels:], camera), depth_at(rows, p, slopes, camera)
    return Render(
        sums[..., 0:3], depth, b.alpha, variance_of(sums), b.moment, torch.where(crossed, nearest, 0.0), b.median_id,
        b.dominant_id, b.dominant_weight,
    )  # fmt: skip


class FieldRenderer:
    """Renders repeatedly with the same settings. Each field is copied to a device once, so the last two fields rendered
    must not change in between.

    refined: a field and the focal length of the images that it was refined on (`as_refined`); None: no field is
    refined on images larger than those rendered.
    """

    def __init__(
        self, options: RenderConfig, backend: str, refined: tuple[GaussianField, float | None] | None = None
    ) -> None:
        self.options, self.backend, self.refined = options, backend, refined
        self._kept: deque[tuple[GaussianField, GaussianField]] = deque(maxlen=2)

    def __call__(
        self, field: GaussianField, camera: Camera, T_camera_world: Tensor | NDArray[np.floating],
        depth_reference: Tensor | None = None,
    ) -> Render:  # fmt: skip
        """Render a field as `render` does."""
        copied = next((copy for one, copy in self._kept if one is field), None)
        if copied is None:
            copied = on_device(field, self.backend)
            self._kept.append((field, copied))
        refined, refined_fx = self.refined or (None, None)
        options = as_refined(self.options, camera, refined_fx if field is refined else None)
        return render(copied, camera, T_camera_world, depth_reference, options, self.backend)


@dataclass(frozen=True)
class SmallerImageConfig(RenderConfig):
    """Rendering of a map in images that are smaller than those it was refined on."""

    low_pass_px2: float = 0.0


def as_refined(options: RenderConfig, camera: Camera, refined_fx: float | None) -> RenderConfig:
    """Return the settings that show a map in an image of `camera`.

    refined_fx: focal length in pixels of the images that the map was refined on; None: images of any size.

    The low-pass keeps its size on the scene, so it has fewer px² in a smaller image. Otherwise splats that are smaller
    than a pixel would count as much as a pixel, because the low-pass widens splats without making them fainter (the
    fault that Mip-Splatting describes, arXiv 2311.16493).
    """
    if refined_fx is None or camera.fx >= refined_fx:
        return options
    low_pass_px2 = options.low_pass_px2 * (camera.fx / refined_fx) ** 2
    return SmallerImageConfig(**(vars(options) | {"low_pass_px2": low_pass_px2}))
