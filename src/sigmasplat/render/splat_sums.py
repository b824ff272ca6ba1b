"""Sum pixel values over the pixels of each splat, and render values of splats, with the kernels of any view.

The weight w_ip of splat i at pixel p is that of the render: Ĉ_p = Σ_i w_ip c_i. `accumulate` and `render_values` apply
the matrix w and its transpose.
"""

import torch
from torch import Tensor

from sigmasplat.model.field import COLUMNS
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

CHANNELS = 3
"""Planes of one pass: they use the colour channels."""


def accumulate(view: View, params: Tensor, T_camera_world: Matrix, planes: Tensor) -> Tensor:
    """Return Σ_p w_ip g_p [N, 3] of three planes g [3, H, W] for rows [N, 17] at a pose.

    The colour of a pixel is linear in the splats' colours, so this is the gradient of the colours if g is the gradient
    of the image. Planes may be padded like those of the view. The view's planes hold the render of `params` afterwards;
    its gradient planes are 0. Rows and planes may be in host memory; the result is on the device of the planes.
    """
    params = params.to(view.sums.device)
    view.forward(params, T_camera_world)
    return gather(view, params, planes).to(planes.device, copy=True)


def gather(view: View, params: Tensor, planes: Tensor) -> Tensor:
    """Return the sums of `accumulate` for the view's last forward pass, of rows `params`; all on the view's device."""
    g_params = torch.empty_like(params)
    view.g_sums.zero_()
    view.g_alpha.zero_()
    height, width = planes.shape[-2:]
    view.g_sums[:CHANNELS, :height, :width] = planes
    view.backward(params, g_params)
    view.g_sums.zero_()
    return g_params[:, COLUMNS["colors"]]


def render_values(view: View, params: Tensor, T_camera_world: Matrix, values: Tensor) -> Tensor:
    """Return Σ_i w_ip v_i [3, H, W] of values [N, 3] of the splats of rows [N, 17] at a pose, without padding.

    Rows and values may be in host memory; the result is on the device of the values.
    """
    rows = params.to(view.sums.device, copy=True)
    rows[:, COLUMNS["colors"]] = values.to(rows)
    view.forward(rows, T_camera_world)
    return view.sums[:CHANNELS, : view.camera.height, : view.camera.width].to(values.device, copy=True)
