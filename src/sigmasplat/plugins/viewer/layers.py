"""Colour the map: the splats that the browser draws, and the layers that SigmaSplat renders from its viewpoint."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

import sigmasplat.api as api
from sigmasplat.api import Camera, GaussianField, RenderConfig, se3
from sigmasplat.plugins.evaluation.view_scores import COVERED_ALPHA, as_array
from sigmasplat.plugins.outputs.drawing import colormap
from sigmasplat.plugins.outputs.drawing.view_panels import colour_bar
from sigmasplat.plugins.viewer.snapshot import Piece, field_without_moments

Floats = NDArray[np.float32]


def uncertainties(piece: Piece) -> Tensor:
    """Return how unsure each splat is [N]: its depth_std_m, m, if that is known, else σ, the root of the mean σ² of the
    colour channels (colours in [0, 1])."""
    return piece.field.variances.mean(1).sqrt() if piece.depth_std_m is None else piece.depth_std_m


class SplatArrays(NamedTuple):
    """N splats to draw: centers [N, 3] m and covariances [N, 3, 3] m² in the piece's frame, colors [N, 3] uint8,
    opacities [N, 1]."""

    centers: Floats
    covariances: Floats
    colors: colormap.Rgb
    opacities: Floats


def shown(piece: Piece, unsure: bool) -> Tensor:
    """Return which splats are shown, bool [N]: the sure ones, or all if `unsure` or if it was not measured."""
    return torch.ones(len(piece.field), dtype=torch.bool) if unsure or piece.sure is None else piece.sure


def palette_range(pieces: Sequence[Piece], unsure: bool) -> tuple[float, float]:
    """Return the range of uncertainties that the palette covers, in equal ratios: that of nearly all shown splats."""
    shown_ones = (uncertainties(piece)[shown(piece, unsure)].numpy() for piece in pieces)
    values = np.concatenate([np.empty(0, np.float32), *shown_ones])
    low, high = np.quantile(values, (0.02, 0.98)) if len(values) else (1.0, 2.0)
    return max(float(low), 1e-9), float(high)


def splat_arrays(piece: Piece, span: tuple[float, float] | None, unsure: bool) -> SplatArrays:
    """Return the shown splats in their own colours, or by uncertainty, in equal ratios over the range `span`."""
    mask = shown(piece, unsure)
    chosen = field_without_moments(piece.field.params[mask], {})
    if span is not None:
        values = np.log(uncertainties(piece)[mask].clamp(min=span[0]).numpy())
        colors = colormap.apply(values, float(np.log(span[0])), float(np.log(span[1])), colormap.INFERNO)
    else:
        colors = np.asarray((chosen.colors.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8))
    spread = covariances(chosen.quats.numpy(), chosen.scales.numpy())
    return SplatArrays(chosen.means.numpy(), spread, colors, chosen.opacities.numpy()[:, None])


def covariances(quats_wxyz: Floats, scales: Floats) -> Floats:
    """Return R diag(s²) Rᵀ [N, 3, 3] for quaternions [N, 4] wxyz of any norm and scales s [N, 3] m."""
    spread = se3.rotation_from_quaternion(np.asarray(quats_wxyz, np.float64)) * scales[:, None, :]
    return np.asarray(spread @ spread.transpose(0, 2, 1), np.float32)


class ShownMap(NamedTuple):
    """The splats that are shown, in the world frame, how sure they are if measured, and how they are rendered."""

    field: GaussianField
    known: api.MapUncertainty | None
    options: RenderConfig
    backend: str


def merged(pieces: Sequence[Piece], unsure: bool, options: RenderConfig, backend: str) -> ShownMap:
    """Return the shown splats of all pieces; how sure they are is known only for a single piece."""
    parts = (piece.field.part(shown(piece, unsure)).moved(torch.from_numpy(piece.T_world_piece)) for piece in pieces)
    known = pieces[0].uncertainty if len(pieces) == 1 else None
    known = None if known is None else known.at(shown(pieces[0], unsure))
    return ShownMap(GaussianField.side_by_side(parts), known, options, backend)


MODES = {
    "splats": "the map, quick to turn",
    "colour": "the map, drawn exactly",
    "depth": "distance from here",
    "V": "spread of colours (√V)",
    "U": "thickness of surfaces (√U)",
    "color error": "expected error of colour",
    "depth error": "expected error of distance",
}
"""What the viewer can show, with its label: the splats, or a layer that SigmaSplat renders from the browser's
viewpoint. A new one needs its branch in `render_layer`; lines and markers are in scene.py."""
PREDICTED_MODES = ("color error", "depth error")
"""Only for maps with predicted errors."""
LEGEND_SIZE, LEGEND_BAR, INK, PAPER = (280, 34), 14, (233, 237, 242), (36, 40, 46)


class Legend(NamedTuple):
    """A palette [K, 3], the values at its two ends, and their unit."""

    palette: NDArray[np.float64]
    low: float
    high: float
    unit: str


class LayerImage(NamedTuple):
    """Pixels uint8 [H, W, 3], and their legend unless they show the scene's own colours."""

    pixels: colormap.Rgb
    legend: Legend | None = None


def browser_camera(fov: float, aspect: float, height: int) -> Camera:
    """Return a browser's camera from its vertical field of view (radians), width / height, and the image's height."""
    width, f = max(round(height * aspect), 1), 0.5 * height / np.tan(0.5 * fov)
    return Camera(width, height, float(f), float(f), 0.5 * (width - 1), 0.5 * (height - 1))


def render_layer(shown: ShownMap, camera: Camera, T_world_camera: api.Matrix, layer: str) -> LayerImage:
    """Render a map and draw one layer of the result.

    Layers: colour; depth D̂/A in m; V: √V averaged over the channels, colours being 0 to 1 (VarSplat §1); U: √U about
    that depth, in m (CG-SLAM eq. 10); the predicted standard deviation of colour ("color error") or of depth in m
    ("depth error"). All but colours are drawn only where A > ½; colour is predicted where the map is empty too.
    """
    field, known, options, backend = shown
    T_camera_world = se3.inverse(T_world_camera)
    with torch.no_grad():
        if layer in PREDICTED_MODES and known is not None:
            parts = api.variance_parts(field, known.splats, known.background, camera, T_camera_world, options, backend)
            found, covered = api.predicted(parts, known.calibration), as_array(parts.alpha) > COVERED_ALPHA
            if layer == "color error":
                return _from_zero(as_array(found.color.sqrt()), np.ones_like(covered), "")
            return _from_zero(as_array(found.depth_std_m), covered, " m")
        seen = api.render(field, camera, T_camera_world, None, options, backend)
        alpha = as_array(seen.alpha)
        covered = alpha > COVERED_ALPHA
        depth_m = np.where(covered, as_array(seen.depth) / np.maximum(alpha, COVERED_ALPHA), 0.0).astype(np.float32)
        if layer == "colour":
            return LayerImage((seen.color.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu().numpy())
        if layer == "depth":
            return _mapped(depth_m, covered, colormap.value_range(depth_m, covered), colormap.VIRIDIS, " m")
        if layer == "V":
            return _from_zero(as_array(seen.variance.mean(2).clamp(min=0.0).sqrt()), covered, "")
        if layer != "U":
            raise ValueError(f"no layer {layer!r} is rendered")
        spread = api.render(field, camera, T_camera_world, torch.from_numpy(depth_m), options, backend).uncertainty
        assert spread is not None
        about = np.sqrt(np.maximum(as_array(spread), 0.0) / np.maximum(alpha, COVERED_ALPHA))
        return _from_zero(about, covered, " m")


def draw_legend(legend: Legend) -> colormap.Rgb:
    """Draw a palette and the values at its ends, uint8 [34, 280, 3]."""
    width, height = LEGEND_SIZE
    image = Image.new("RGB", LEGEND_SIZE, PAPER)
    image.paste(Image.fromarray(colour_bar(legend.palette, width, LEGEND_BAR)), (0, 0))
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(14)
    middle = (height + LEGEND_BAR) // 2
    factor, unit = (100.0, " cm") if legend.unit == " m" and legend.high < 1.0 else (1.0, legend.unit)
    draw.text((1, middle), f"{factor * legend.low:.2g}{unit}", INK, font, anchor="lm")
    draw.text((width - 1, middle), f"{factor * legend.high:.2g}{unit}", INK, font, anchor="rm")
    return np.asarray(image)


def _from_zero(values: Floats, valid: NDArray[np.bool_], unit: str) -> LayerImage:
    return _mapped(values, valid, colormap.from_zero(values, valid), colormap.INFERNO, unit)


def _mapped(
    values: Floats, valid: NDArray[np.bool_], ends: tuple[float, float], colours: NDArray[np.float64], unit: str
) -> LayerImage:
    return LayerImage(colormap.apply_masked(values, valid, *ends, colours), Legend(colours, *ends, unit))
