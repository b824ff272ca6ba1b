"""References for alignment: the rendered map, or a keyframe's own image weighed by the map's V."""

from dataclasses import dataclass

from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.gray import Image
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import Target
from sigmasplat.render.view import View
from sigmasplat.types import Matrix


@dataclass(eq=False)
class Reference:
    """An image with depth and pixel weights to align others to, and its pose T_camera_world [4, 4]."""

    pyramid: Pyramid
    T_camera_world: Matrix


def live_image(view: View, color: Image, depth_m: Image, target: Target) -> Pyramid:
    """Halve what a camera sees, colour [H, W, 3] and depth [H, W] m, where the view's device aligns it."""
    gray, depth = fits_of(view).live_planes(view, color, depth_m, target)
    return Pyramid.of(gray, depth, target.camera, backend=view.backend)


def map_reference(params: Tensor, view: View, T_camera_world: Matrix, config: TrackingConfig) -> Reference:
    """Render the map as a reference: gray C/A and depth D/A m where it is opaque, weighed by w̃ (VarSplat §3).

    params: rows [N, 17]; T_camera_world [4, 4]: the pose to render from. With depth weighed by U it is rendered
    twice, as U is about the surface that the first render finds.
    """
    fits = fits_of(view)
    view.forward(params, T_camera_world)
    maps = fits.reference_maps(view, config, None)
    if config.align_depth_by == "U":
        view.forward(params, T_camera_world, fits.images.as_tensor(maps.depth))
        maps = fits.reference_maps(view, config, view.moment)
    image = Pyramid.of(maps.gray, maps.depth, view.camera, backend=view.backend)
    return Reference(image.weighed(*maps.weights), T_camera_world)


def keyframe_reference(
    params: Tensor, view: View, image: Pyramid, T_camera_world: Matrix, config: TrackingConfig
) -> Reference:
    """Take a keyframe's own image as a reference, each pixel weighed by w̃ of the map seen from there (VarSplat §3).

    params: rows [N, 17]; image: its gray and depth (m) pyramid; T_camera_world [4, 4]: its pose. The sensor's surface
    is unbiased where a young map still renders too near; the map says which pixels to trust. Depth may be weighed by U
    about the sensor's depth instead (CG-SLAM eq. 10).
    """
    if not config.uncertainty:
        return Reference(image, T_camera_world)
    by_U, fits = config.align_depth_by == "U", fits_of(view)
    view.forward(params, T_camera_world, fits.images.as_tensor(image.depth[0]) if by_U else None)
    maps = fits.reference_maps(view, config, view.moment if by_U else None)
    return Reference(image.weighed(*maps.weights), T_camera_world)
