"""The low-pass of images that are smaller than those a map was refined on."""

from dataclasses import replace

from sigmasplat.config import RenderConfig
from sigmasplat.data.camera import Camera


def as_refined(options: RenderConfig, camera: Camera, refined_fx: float | None) -> RenderConfig:
    """Return the settings that show a map in an image of `camera`.

    refined_fx: focal length in pixels of the images that the map was refined on; None: images of any size.

    The low-pass keeps its size on the scene, so it has fewer px² in a smaller image. Otherwise splats that are smaller
    than a pixel would count as much as a pixel, because the low-pass widens splats without making them fainter (the
    fault that Mip-Splatting describes, arXiv 2311.16493).
    """
    if refined_fx is None or camera.fx >= refined_fx:
        return options
    return replace(options, low_pass_px2=options.low_pass_px2 * (camera.fx / refined_fx) ** 2)
