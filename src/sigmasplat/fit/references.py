"""Make references for alignment: the rendered map, or a keyframe's own image weighted by the map's V."""

from dataclasses import dataclass

from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.compare import Comparison, compare
from sigmasplat.fit.gray import Image
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import Target
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.submap import Picture
from sigmasplat.render.view import View
from sigmasplat.types import Matrix


@dataclass(eq=False)
class Reference:
    """An image with depth and pixel weights that other images are aligned to, and its pose T_camera_world [4, 4]."""

    pyramid: Pyramid
    T_camera_world: Matrix

    @property
    def weights(self) -> Image | None:
        """Return the weight of each pixel [H, W] in host memory; None if all are equal."""
        weight = self.pyramid.weight[0]
        return None if weight is None else self.pyramid.kernels.to_host(weight)

    def compared(self, live: Pyramid, T_camera_world: Matrix) -> Comparison:
        """Compare a live image at its pose T_camera_world [4, 4] with this reference."""
        return compare(self.pyramid, live, T_camera_world @ se3.inverse(self.T_camera_world))


def live_image(view: View, color: Image, depth_m: Image, target: Target) -> Pyramid:
    """Make the pyramid of a camera image, colour [H, W, 3] and depth [H, W] m, on the device that aligns it."""
    gray, depth = fits_of(view).live_planes(view, color, depth_m, target)
    return Pyramid.of(gray, depth, target.camera, backend=view.backend)


def picture_images(view: View, picture: Picture, camera: Camera) -> tuple[Target, Pyramid]:
    """Return a stored keyframe's images, taken by `camera`, as the target of a fit and as a pyramid."""
    target = Target.of_picture(picture, camera, (view.sums.shape[1], view.sums.shape[2]))
    return target, live_image(view, picture.unit_color, picture.depth_m, target)


def map_reference(params: Tensor, view: View, T_camera_world: Matrix, config: TrackingConfig) -> Reference:
    """Render the map as a reference: gray C/A and depth D/A in m where it is opaque, weighted by w̃ (VarSplat §3).

    params: rows [N, 17]; T_camera_world [4, 4]: the pose to render from. To weight depth by U the map is rendered
    twice, because U refers to the surface that the first render finds.
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
    """Make a reference from a keyframe's own image; each pixel is weighted by w̃ of the map at its pose (VarSplat §3).

    params: rows [N, 17]; image: its gray and depth (m) pyramid; T_camera_world [4, 4]: its pose. The sensor's surface
    is unbiased, while a young map still renders surfaces too close; the map only supplies the pixel weights. Depth can
    be weighted by U about the sensor's depth instead (CG-SLAM eq. 10).
    """
    if not config.uncertainty:
        return Reference(image, T_camera_world)
    by_U, fits = config.align_depth_by == "U", fits_of(view)
    view.forward(params, T_camera_world, fits.images.as_tensor(image.depth[0]) if by_U else None)
    maps = fits.reference_maps(view, config, view.moment if by_U else None)
    return Reference(image.weighed(*maps.weights), T_camera_world)
