"""Draw one view as a strip of panels: input, rendered colour, depth, uncertainty V and error, with their ranges."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from sigmasplat.plugins.evaluation.metrics.views import COVERED_ALPHA, PredictedErrors, ScoredView
from sigmasplat.plugins.outputs.drawing import colormap

BACKGROUND, TEXT, FAINT = (21, 24, 29), (233, 237, 242), (150, 158, 168)
PANEL_WIDTH, GAP, HEAD, FOOT = 320, 10, 34, 38
PREDICTED_CAPTIONS = (
    "Difference between the image and the rendered colour.",
    "One standard deviation: 68 % of the errors should be smaller.",
    "Noise, and detail that the map cannot show; more views do not reduce it.",
    "The part that more or better views would reduce.",
    "Difference between the depth reading and the rendered depth.",
    "One standard deviation, including the noise of the sensor: 68 % of the errors should be smaller.",
    "Noise of the sensor, and surfaces that the map does not show sharply; more views do not reduce it.",
    "Edges and gaps in the map: the part that more or better views would reduce.",
)
"""What each panel of `predicted_panels` means."""


@dataclass(frozen=True, eq=False)
class ViewPanel:
    """One panel of a strip: title, uint8 pixels, and a colour bar (palette, labels of its ends) or a line of text.

    If a panel has both, the line of text is shown on the page only.
    """

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


def draw_view_strip(panels: Sequence[ViewPanel]) -> Image.Image:
    """Draw panels side by side, an RGB picture `PANEL_WIDTH + GAP` = 330 pixels wide per panel."""
    first = panels[0].pixels
    height = round(PANEL_WIDTH * first.shape[0] / first.shape[1])
    size = (len(panels) * (PANEL_WIDTH + GAP) + GAP, height + HEAD + FOOT)
    strip = Image.new("RGB", size, BACKGROUND)
    for i, panel in enumerate(panels):
        _draw(strip, panel, GAP + i * (PANEL_WIDTH + GAP), height)
    return strip


def view_panels(view: ScoredView) -> list[ViewPanel]:
    """Return the five panels of a view. Uncertainty and error are shown as square roots, in units of colour."""
    depth_range = colormap.value_range(view.recorded_depth_m, view.valid)
    deviation, error = np.sqrt(view.uncertainty), np.sqrt(view.squared_error)
    mapped = view.alpha > COVERED_ALPHA
    score = view.scores()
    return [
        ViewPanel("input", _bytes(view.recorded), " · ".join((f"frame {view.index}", view.kind, *view.notes))),
        ViewPanel(
            "rendered colour", _bytes(view.rendered), f"PSNR {score['psnr_db']:.1f} dB · SSIM {score['ssim']:.3f}"
        ),
        _coloured("rendered depth", view.rendered_depth_m, mapped, depth_range, colormap.VIRIDIS, " m"),
        _coloured("uncertainty, root of V", deviation, mapped, _from_zero(deviation, mapped), colormap.INFERNO),
        _coloured("error, RMS", error, view.valid, _from_zero(error, view.valid), colormap.INFERNO),
    ]


def predicted_panels(view: ScoredView, predicted: PredictedErrors) -> list[ViewPanel]:
    """Return eight panels: the errors of colour and depth, the standard deviations that the map predicts for them, and
    their parts.

    All panels of colour have one range, and all panels of depth. Colour is predicted where the map is empty too.
    """
    everywhere, mapped = np.ones_like(view.valid), view.alpha > COVERED_ALPHA
    error, total = np.sqrt(view.squared_error), np.sqrt(predicted.color)
    error_m, total_m = np.sqrt(view.depth_squared_error), np.sqrt(predicted.reading_m2)
    aleatoric, epistemic = np.sqrt(predicted.color_aleatoric), np.sqrt(predicted.color_epistemic)
    aleatoric_m, epistemic_m = np.sqrt(predicted.reading_aleatoric_m2), np.sqrt(predicted.depth_epistemic_m2)
    color = 0.0, max(_from_zero(error, view.valid)[1], _from_zero(total, everywhere)[1])
    depth_m = 0.0, max(_from_zero(error_m, view.depth_compared)[1], _from_zero(total_m, mapped)[1])
    inferno = colormap.INFERNO
    panels = [
        _coloured("colour error, RMS", error, view.valid, color, inferno),
        _coloured("predicted colour error", total, everywhere, color, inferno),
        _coloured("colour: aleatoric part", aleatoric, everywhere, color, inferno),
        _coloured("colour: epistemic part", epistemic, everywhere, color, inferno),
        _coloured("depth error", error_m, view.depth_compared, depth_m, inferno, " m"),
        _coloured("predicted depth error", total_m, mapped, depth_m, inferno, " m"),
        _coloured("depth: aleatoric part", aleatoric_m, mapped, depth_m, inferno, " m"),
        _coloured("depth: epistemic part", epistemic_m, mapped, depth_m, inferno, " m"),
    ]
    return [replace(panel, caption=caption) for panel, caption in zip(panels, PREDICTED_CAPTIONS, strict=True)]


def _from_zero(values: NDArray[np.float32], valid: NDArray[np.bool_]) -> tuple[float, float]:
    """Return 0 and the 99th percentile of the valid values."""
    return 0.0, colormap.value_range(values, valid)[1]


def _coloured(
    title: str,
    values: NDArray[np.float32],
    valid: NDArray[np.bool_],
    limits: tuple[float, float],
    colours: NDArray[np.float64],
    unit: str = "",
) -> ViewPanel:
    """Apply a colour map, and label its range."""
    digits = 2 if unit and limits[1] >= 1.0 else 3
    ends = (f"{limits[0]:.{digits}f}{unit}", f"{limits[1]:.{digits}f}{unit}")
    return ViewPanel(title, colormap.apply_masked(values, valid, *limits, colours), bar=colours, ends=ends)


def _bytes(color: NDArray[np.float32]) -> colormap.Rgb:
    """Convert colours in [0, 1] to 0 … 255."""
    return (np.clip(color, 0.0, 1.0) * 255.0).round().astype(np.uint8)


def _draw(strip: Image.Image, panel: ViewPanel, left: int, height: int) -> None:
    """Draw one panel in the strip: title above, picture, bar or caption below."""
    draw = ImageDraw.Draw(strip)
    draw.text((left + 2, HEAD // 2), panel.title, TEXT, ImageFont.load_default(18), anchor="lm")
    strip.paste(panel.picture(PANEL_WIDTH, height), (left, HEAD))
    middle = HEAD + height + FOOT // 2
    small = ImageFont.load_default(16)
    if panel.bar is None:
        draw.text((left + 2, middle), panel.caption, FAINT, small, anchor="lm")
        return
    draw.text((left + 2, middle), panel.ends[0], FAINT, small, anchor="lm")
    draw.text((left + PANEL_WIDTH - 2, middle), panel.ends[1], FAINT, small, anchor="rm")
    ramp = colormap.apply(np.tile(np.linspace(0.0, 1.0, PANEL_WIDTH - 160), (10, 1)), 0.0, 1.0, panel.bar)
    strip.paste(Image.fromarray(ramp), (left + 80, middle - 5))
