"""Make references for alignment: the rendered map, or a keyframe's own image weighted by the map's V."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.config.input import SensorModel
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.images import alignment_std, generic_std
from sigmasplat.data.submap import Picture
from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.compare import Comparison, compare
from sigmasplat.fit.interface import Plane
from sigmasplat.fit.pyramid import NOISE_PER_M, Pyramid
from sigmasplat.fit.target import Image, Target
from sigmasplat.render.view import View
from sigmasplat.types import Matrix

USUAL_M = 2.0
"""Distance of a wall of a room."""


@dataclass(eq=False)
class Reference:
    """An image with depth and pixel weights that other images are aligned to, and its pose T_camera_world [4, 4].
    keyframe: its number in the active submap, if the camera was found there; −1: the newest one."""

    pyramid: Pyramid
    T_camera_world: Matrix
    keyframe: int = -1

    @property
    def depth_m(self) -> Image:
        """Return the depth [H, W], m, in host memory."""
        return self.pyramid.kernels.to_host(self.pyramid.depth[0])

    def without(self, hidden: NDArray[np.bool_]) -> "Reference":
        """Return the reference without depth at some pixels [H, W], so that nothing is aligned to them."""
        return replace(self, pyramid=self.pyramid.with_depth(np.where(hidden, np.float32(0.0), self.depth_m)))

    def moved_by(self, T_new_old: Matrix) -> "Reference":
        """Return the reference with its pose in other coordinates [4, 4]."""
        return replace(self, T_camera_world=self.T_camera_world @ se3.inverse(T_new_old))

    def compared(self, live: Pyramid, T_camera_world: Matrix) -> Comparison:
        """Compare a live image at its pose T_camera_world [4, 4] with this reference."""
        return compare(self.pyramid, live, T_camera_world @ se3.inverse(self.T_camera_world))


def live_image(view: View, color: Image, depth_m: Image, target: Target) -> Pyramid:
    """Make the pyramid of a camera image, colour [H, W, 3] and depth [H, W] m, on the device that aligns it."""
    gray, depth = fits_of(view).live_planes(view, color, depth_m, target)
    return _pyramid(view, gray, depth, target.camera, depth_m)


def relative_noise(depth_m: Image, sensor: SensorModel, noise_per_m: float = NOISE_PER_M) -> Image:
    """Return σ of readings in alignment [H, W], relative to the law noise_per_m · z²; 1 without a reading."""
    std_m, law_m = alignment_std(depth_m, sensor), generic_std(depth_m, noise_per_m)
    return np.divide(std_m, law_m, out=np.ones_like(law_m), where=law_m > 0)


def confidence_of(sensor: SensorModel, noise_per_m: float = NOISE_PER_M, scene_scale: float = 1.0) -> float:
    """Return how many times as sure as noise_per_m · z² a sensor's readings are in alignment, at a wall's distance."""
    wall_m = np.full(1, USUAL_M * scene_scale, np.float32)
    return float((generic_std(wall_m, noise_per_m) / alignment_std(wall_m, sensor))[0])


def _pyramid(view: View, gray: Plane, depth: Plane, camera: Camera, depth_m: Image | None = None) -> Pyramid:
    """Build a pyramid on the device of a view, with its assumptions on scene and sensor; depth_m [H, W]: the depth in
    host memory, if it is there.

    All depth is aligned to readings, also that of a rendered map. So all has the noise of a reading at its distance.
    """
    o, images, noise, confidence = view.options, fits_of(view).images, None, 1.0
    if view.sensor is not None:
        host_m = images.to_host(depth) if depth_m is None else depth_m
        noise = images.beside(relative_noise(host_m, view.sensor, o.depth_noise_per_m), depth)
        confidence = confidence_of(view.sensor, o.depth_noise_per_m, o.scene_scale)
    return Pyramid.of(
        gray, depth, camera, backend=view.backend, scene_scale=o.scene_scale, noise_per_m=o.depth_noise_per_m,
        noise=noise, confidence=confidence,
    )  # fmt: skip


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
    image = _pyramid(view, maps.gray, maps.depth, view.camera)
    return Reference(image.weighed(*maps.weights), T_camera_world)


def keyframe_reference(
    params: Tensor, view: View, image: Pyramid, T_camera_world: Matrix, config: TrackingConfig,
) -> Reference:  # fmt: skip
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
