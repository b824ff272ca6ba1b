"""Weigh pixels by the variance that a map predicts (`render.predictive`) instead of V as published.

Every weight reads V = Σw(σ²+c²) − Ĉ² of a view. Here the squared residuals of the splats are first added to their σ².
Then the planes of the view are changed so that the same formula gives the predicted variance. So no kernel and no
formula of a weight changes.
"""

import torch
from torch import Tensor

from sigmasplat.data.field import COLUMNS
from sigmasplat.data.map_uncertainty import SHIPPED, Background
from sigmasplat.fit.splat_residuals import PSEUDO_PIXELS, background_of
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.render.predictive import COVERED, slope2, unexplained
from sigmasplat.render.splat_sums import gather
from sigmasplat.render.view import View
from sigmasplat.types import Matrix


def with_residuals(params: Tensor, residuals: Tensor) -> Tensor:
    """Return rows [N, 17] with σ² + (a_r r² + a_f) / a_m in place of σ²; residuals [N]: r², colour².

    a_m, a_r and a_f are the shipped weights of mixture, residual and floor. V of these rows, times a_m, is the weighted
    sum of these parts.
    """
    a, column = SHIPPED.color, COLUMNS["log_variances"]
    rows = params.clone()
    added = (a["residual"] * residuals.to(rows) + a["floor"]) / a["mixture"]
    rows[:, column] = (rows[:, column].exp() + added[:, None]).log()
    return rows


def residuals_at(params: Tensor, view: View, target: Target, T_camera_map: Matrix) -> Tensor:
    """Return the squared residual of colour of each splat [N] at one keyframe: Σ_p w_ip e_p² / Σ_p w_ip.

    One render and one backward pass. Splats that are hardly seen take the mean of the image.
    """
    h, w = view.camera.height, view.camera.width
    view.forward(params, T_camera_map)
    rendered, image = view.sums[:3, :h, :w].clamp(0.0, 1.0), target.to(view.sums.device).color[:, :h, :w]
    squared = (rendered - image).square().mean(0)
    planes = torch.stack([squared, torch.ones_like(squared), torch.zeros_like(squared)])
    errors, weights, _ = gather(view, params, planes).unbind(1)
    return (errors + PSEUDO_PIXELS * squared.mean()) / (weights + PSEUDO_PIXELS)


def predicted_at(params: Tensor, view: View, target: Target, T_camera_map: Matrix) -> tuple[Tensor, Background]:
    """Return rows [N, 17] for `use_predicted_variance`, measured at one keyframe, and its background."""
    background = background_of([Keyframe(0, target, T_camera_map)])
    return with_residuals(params, residuals_at(params, view, target, T_camera_map)), background


def use_predicted_variance(view: View, background: Background) -> None:
    """Change the planes of a view's last forward pass, of rows `with_residuals`, so that V becomes the predicted
    variance."""
    h, w, a = view.camera.height, view.camera.width, SHIPPED.color
    color, second, alpha = view.sums[:3, :h, :w], view.sums[4:7, :h, :w], view.alpha[:h, :w]
    of_splats = (second - color.square() / alpha.clamp(min=1e-6)).mean(0).clamp(min=0.0)
    image = color.movedim(0, -1)
    empty, edges = unexplained(image, alpha, background), slope2(image, view.camera).mean(-1)
    variance = a["mixture"] * of_splats + a["unexplained"] * empty + a["edges"] * edges
    second.copy_(color.square() + variance)


def use_predicted_depth_variance(view: View) -> None:
    """Change `moment` of a view, U about a reading of the sensor, to the predicted variance of depth [m²].

    U about the reading contains the residual of depth, (D̂ − D)², so splats need no residuals of depth. Pixels without U
    keep 0.
    """
    h, w, a = view.camera.height, view.camera.width, SHIPPED.depth
    moment, covered = view.moment[:h, :w], view.alpha[:h, :w].clamp(min=COVERED)
    depth_m = view.sums[3, :h, :w] / covered
    edges = slope2(depth_m[..., None], view.camera)[..., 0]
    variance = a["ray"] * moment / covered + a["edges"] * edges + a["sensor"] * depth_m**4 + a["floor"]
    moment.copy_(torch.where(moment > 0, variance, 0.0))
