"""Depth behind the median gate (`render.depth_gate_m`) for renders made of `project` and `blend`.

The gated depth of a splat depends on the pixel's median depth, so it is not a feature that `blend` can sum. The views
have it; this module renders a view's depth as a differentiable function of a field's rows and the pose.
"""

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.render.backend import make_view
from sigmasplat.render.pose_gradient import pose_gradient


class _GatedDepth(torch.autograd.Function):
    @staticmethod
    def forward(ctx, params, T, camera, options, backend):  # type: ignore[no-untyped-def]
        rows, view = params.detach().contiguous(), make_view(backend, camera, options, variance=False)
        with torch.enable_grad():  # the reference view differentiates by autograd
            view.forward(rows, T.detach().double().numpy())
        ctx.view = view
        ctx.save_for_backward(rows, T)
        return view.sums[3, : camera.height, : camera.width].to(params, copy=True)

    @staticmethod
    def backward(ctx, g_depth):  # type: ignore[no-untyped-def]
        (rows, T), view = ctx.saved_tensors, ctx.view
        view.g_sums.zero_()
        view.g_alpha.zero_()
        view.g_sums[3, : view.camera.height, : view.camera.width] = g_depth
        found = torch.empty_like(rows)
        twist = view.backward(rows, found)
        return found, pose_gradient(T, np.asarray(twist)), None, None, None


def gated_depth(params: Tensor, T_camera_world: Tensor, camera: Camera, options: RenderConfig, backend: str) -> Tensor:
    """Render the depth Σ w d [H, W], m, of rows [N, 17] behind the median gate; the gradient reaches rows and pose.

    It is computed in float32. Raises BackendError as `make_view` does.
    """
    return _GatedDepth.apply(params, T_camera_world, camera, options, backend)  # type: ignore[no-any-return, no-untyped-call]
