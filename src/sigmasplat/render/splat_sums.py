"""Sum pixel values over the pixels of each splat, with the weights of the last render of a view."""

import torch
from torch import Tensor

from sigmasplat.data.field import COLUMNS
from sigmasplat.render.cpu.view import CpuView
from sigmasplat.render.view import View

CHANNELS = 3
"""Planes of one pass: they use the colour channels."""


def gather(view: View, params: Tensor, planes: Tensor) -> Tensor:
    """Return Σ_p w_ip g_p [N, 3] of three planes g [3, H, W] for the last forward pass of a view, of rows [N, 17];
    all on the view's device.

    The colour of a pixel is linear in the splats' colours, so this is the gradient of the colours if g is the gradient
    of the image. The view's gradient planes of colour are 0 afterwards.
    """
    view.g_sums.zero_()
    view.g_alpha.zero_()
    height, width = planes.shape[-2:]
    view.g_sums[:CHANNELS, :height, :width] = planes
    if isinstance(view, CpuView):  # its kernels sum without the gradient of the alphas
        sums = view.gather(view.g_sums[:CHANNELS])
        view.g_sums.zero_()
        return sums
    g_params = torch.empty_like(params)
    view.backward(params, g_params)
    view.g_sums.zero_()
    return g_params[:, COLUMNS["colors"]]
