"""Render the map from the browser's viewpoint with our own renderer, and colour the maps that it gives."""

from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.drawing import colormap
from sigmasplat.metrics.scored_view import COVERED_ALPHA
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.render import render
from sigmasplat.types import Matrix

Layer = Literal["colour", "depth", "V", "U", "opacity"]
Floats = NDArray[np.float32]
GREY = np.array([(0, 0, 0), (255, 255, 255)], np.float64)
LEGEND_SIZE, LEGEND_BAR, INK, PAPER = (280, 34), 14, (233, 237, 242), (36, 40, 46)


class Legend(NamedTuple):
    """What a palette [K, 3] stands for: its ends, and their unit."""

    palette: NDArray[np.float64]
    low: float
    high: float
    unit: str


class Picture(NamedTuple):
    """Pixels uint8 [H, W, 3], and what their colours mean where they are not the scene's own."""

    pixels: colormap.Rgb
    legend: Legend | None = None


def viewpoint(fov: float, aspect: float, height: int) -> Camera:
    """Return the camera of a browser: vertical field of view in radians, width over height, rows of the image."""
    width, f = max(round(height * aspect), 1), 0.5 * height / np.tan(0.5 * fov)
    return Camera(width, height, float(f), float(f), 0.5 * (width - 1), 0.5 * (height - 1))


def picture_of(
    field: GaussianField, camera: Camera, T_world_camera: Matrix, layer: Layer, options: RenderConfig, backend: str
) -> Picture:
    """Render a field and show one layer of what comes out: colour; depth D̂/A, m; V as a root, mean over channels, in
    colour steps (VarSplat §1); U about that depth as a root, m (CG-SLAM eq. 10); opacity A.

    All but colour and opacity are shown where A > ½ only.
    """
    T_camera_world = se3.inverse(T_world_camera)
    with torch.no_grad():
        seen = render(field, camera, T_camera_world, None, options, backend)
        alpha = _array(seen.alpha)
        covered = alpha > COVERED_ALPHA
        depth_m = np.where(covered, _array(seen.depth) / np.maximum(alpha, COVERED_ALPHA), 0.0).astype(np.float32)
        if layer == "colour":
            return Picture((seen.color.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu().numpy())
        if layer == "opacity":
            return Picture(colormap.apply(alpha, 0.0, 1.0, GREY), Legend(GREY, 0.0, 1.0, ""))
        if layer == "depth":
            return _mapped(depth_m, covered, colormap.value_range(depth_m, covered), colormap.VIRIDIS, " m")
        if layer == "V":
            return _from_zero(_array(seen.variance.mean(2).clamp(min=0.0).sqrt()), covered, "")
        spread = render(field, camera, T_camera_world, torch.from_numpy(depth_m), options, backend).uncertainty
        assert spread is not None
        about = np.sqrt(np.maximum(_array(spread), 0.0) / np.maximum(alpha, COVERED_ALPHA))
        return _from_zero(about, covered, " m")


def legend_picture(legend: Legend) -> colormap.Rgb:
    """Draw a palette with the values of its ends, uint8 [34, 280, 3]."""
    width, height = LEGEND_SIZE
    image = Image.new("RGB", LEGEND_SIZE, PAPER)
    ramp = colormap.apply(np.tile(np.linspace(0.0, 1.0, width), (LEGEND_BAR, 1)), 0.0, 1.0, legend.palette)
    image.paste(Image.fromarray(ramp), (0, 0))
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(14)
    middle = (height + LEGEND_BAR) // 2
    draw.text((1, middle), f"{legend.low:.3g}{legend.unit}", INK, font, anchor="lm")
    draw.text((width - 1, middle), f"{legend.high:.3g}{legend.unit}", INK, font, anchor="rm")
    return np.asarray(image)


def _array(values: Tensor) -> Floats:
    return np.asarray(values.cpu(), np.float32)


def _from_zero(values: Floats, valid: NDArray[np.bool_], unit: str) -> Picture:
    return _mapped(values, valid, (0.0, colormap.value_range(values, valid)[1]), colormap.INFERNO, unit)


def _mapped(
    values: Floats, valid: NDArray[np.bool_], ends: tuple[float, float], colours: NDArray[np.float64], unit: str
) -> Picture:
    return Picture(colormap.apply_masked(values, valid, *ends, colours), Legend(colours, *ends, unit))
