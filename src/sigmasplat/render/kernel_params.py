"""Convert camera, pose and switches to the struct that all kernels read."""

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.render.reference.operators import FRUSTUM_MARGIN


def view_params(
    camera: Camera, T_camera_world: NDArray[np.floating], options: RenderConfig, dtype: type = np.float32
) -> NDArray[np.floating]:
    """Return camera, pose and switches as the kernels' `View` (native/splat.h)."""
    T = np.asarray(T_camera_world, np.float64)
    margin_u, margin_v = FRUSTUM_MARGIN * camera.width, FRUSTUM_MARGIN * camera.height
    limits = [
        -(camera.cx + margin_u) / camera.fx,
        (camera.width - camera.cx + margin_u) / camera.fx,
        -(camera.cy + margin_v) / camera.fy,
        (camera.height - camera.cy + margin_v) / camera.fy,
    ]
    switches = [True, options.covariance_pose_gradient, True]  # pose gradient through 2D mean, 2D covariance, depth
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *T[:3, :3].ravel(), *T[:3, 3]]
    numbers += [options.near_m, options.low_pass_px2, *limits, camera.width, camera.height, *map(float, switches)]
    return np.array(numbers, dtype)
