"""Draw one view as a strip of panels: input, rendered colour, depth, uncertainty V and error, with their ranges."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from sigmasplat.api import to_bytes
from sigmasplat.plugins.evaluation.view_scores import COVERED_ALPHA, ScoredView
from sigmasplat.plugins.outputs.drawing import colormap

BACKGROUND, TEXT, FAINT = (21, 24, 29), (233, 237, 242), (150, 158, 168)
PANEL_WIDTH, GAP, HEAD, FOOT = 320, 10, 34, 38
LEAST_WIDTH = 200
"""Narrower panels have no texts."""


@dataclass(frozen=True, eq=False)
class ViewPanel:
    """One panel of a strip: title, uint8 pixels, and a colour bar (palette, labels of its ends) or a line of text."""

    title: str
    pixels: colormap.Rgb
    caption: str = ""
    bar: NDArray[np.float64] | None = None
    ends: tuple[str, str] = ("", "")

    def picture(self, width: int, height: int) -> Image.Image:
        """Return the pixels as a picture of this size; small maps with a colour bar keep sharp pixels."""
        enlarged = self.pixels.shape[1] < width
        how = Image.Resampling.NEAREST if enlarged and self.bar is not None else Image.Resampling.LANCZOS
        return Image.fromarray(self.pixels).resize((width, height), how)


def draw_view_strip(panels: Sequence[ViewPanel], width: int = PANEL_WIDTH) -> Image.Image:
    """Draw panels of this width side by side, an RGB picture; panels too narrow for their texts only have pictures."""
    first = panels[0].pixels
    height = round(width * first.shape[0] / first.shape[1])
    gap, head, foot = (GAP, HEAD, FOOT) if width >= LEAST_WIDTH else (0, 0, 0)
    strip = Image.new("RGB", (len(panels) * (width + gap) + gap, height + head + foot), BACKGROUND)
    for i, panel in enumerate(panels):
        left = gap + i * (width + gap)
        strip.paste(panel.picture(width, height), (left, head))
        if head:
            _draw_texts(strip, panel, left, width, height)
    return strip


def view_panels(view: ScoredView) -> list[ViewPanel]:
    """Return the five panels of a view. Uncertainty and error are shown as square roots, in units of colour: the
    predicted error in the range of the error if it is known, else V."""
    depth_range = colormap.value_range(view.recorded_depth_m, view.valid)
    deviation, error = np.sqrt(view.uncertainty), np.sqrt(view.squared_error)
    mapped = view.alpha > COVERED_ALPHA
    score, limits = view.scores(), colormap.from_zero(error, view.valid)
    unsure = coloured(
        "uncertainty, root of V", deviation, mapped, colormap.from_zero(deviation, mapped), colormap.INFERNO
    )
    if view.predicted is not None:  # where the map is empty too
        everywhere, total = np.ones_like(mapped), np.sqrt(view.predicted.color)
        limits = 0.0, max(limits[1], colormap.from_zero(total, everywhere)[1])
        unsure = coloured("predicted colour error", total, everywhere, limits, colormap.INFERNO)
    recorded, rendered = (to_bytes(color * 255.0) for color in (view.recorded, view.rendered))
    return [
        ViewPanel("input", recorded, " · ".join((f"frame {view.index}", view.kind, *view.notes))),
        ViewPanel("rendered colour", rendered, f"PSNR {score['psnr_db']:.1f} dB · SSIM {score['ssim']:.3f}"),
        coloured("rendered depth", view.rendered_depth_m, mapped, depth_range, colormap.VIRIDIS, " m"),
        unsure,
        coloured("error, RMS", error, view.valid, limits, colormap.INFERNO),
    ]


def coloured(
    title: str, values: NDArray[np.float32], valid: NDArray[np.bool_], limits: tuple[float, float],
    colours: NDArray[np.float64], unit: str = "",
) -> ViewPanel:  # fmt: skip
    """Return a panel of values [H, W] in a colour map, with its range."""
    digits = 2 if unit and limits[1] >= 1.0 else 3
    ends = (f"{limits[0]:.{digits}f}{unit}", f"{limits[1]:.{digits}f}{unit}")
    return ViewPanel(title, colormap.apply_masked(values, valid, *limits, colours), bar=colours, ends=ends)


def _draw_texts(strip: Image.Image, panel: ViewPanel, left: int, width: int, height: int) -> None:
    draw, middle, small = ImageDraw.Draw(strip), HEAD + height + FOOT // 2, ImageFont.load_default(16)
    draw.text((left + 2, HEAD // 2), panel.title, TEXT, ImageFont.load_default(18), anchor="lm")
    if panel.bar is None:
        draw.text((left + 2, middle), panel.caption, FAINT, small, anchor="lm")
        return
    draw.text((left + 2, middle), panel.ends[0], FAINT, small, anchor="lm")
    draw.text((left + width - 2, middle), panel.ends[1], FAINT, small, anchor="rm")
    strip.paste(Image.fromarray(colour_bar(panel.bar, width - 160, 10)), (left + 80, middle - 5))


def colour_bar(palette: NDArray[np.float64], width: int, height: int) -> colormap.Rgb:
    """Return a palette from its low to its high end, uint8 [height, width, 3]."""
    return colormap.apply(np.tile(np.linspace(0.0, 1.0, width), (height, 1)), 0.0, 1.0, palette)
