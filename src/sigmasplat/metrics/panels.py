"""Show one view as a strip: input, rendered colour, depth, uncertainty V and error, side by side with their ranges."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from sigmasplat.metrics import palette
from sigmasplat.metrics.image import depth_l1, psnr, ssim

BACKGROUND, TEXT, FAINT = (21, 24, 29), (233, 237, 242), (150, 158, 168)
PANEL_WIDTH, GAP, HEAD, FOOT = 320, 10, 34, 38
COVERED_ALPHA = 0.5
"""Above this alpha the map is taken to have a surface there (depth = Σwz / Σw is meant)."""


@dataclass(frozen=True, eq=False)
class View:
    """A recorded image and its rendering at the estimated pose, float32.

    recorded, rendered: [H, W, 3] in [0, 1]; recorded_depth_m [H, W] (0 = no reading); rendered_depth_m [H, W]
    (0 where alpha ≤ ½); alpha [H, W]; variance: V [H, W, 3], colour² (VarSplat §1); notes are written under the strip.
    """

    index: int
    kind: str
    recorded: NDArray[np.float32]
    recorded_depth_m: NDArray[np.float32]
    rendered: NDArray[np.float32]
    rendered_depth_m: NDArray[np.float32]
    alpha: NDArray[np.float32]
    variance: NDArray[np.float32]
    notes: tuple[str, ...] = field(default=())

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Return the pixels with a depth reading [H, W]: the ones every score is taken on."""
        return self.recorded_depth_m > 0

    @property
    def uncertainty(self) -> NDArray[np.float32]:
        """Return V averaged over the channels [H, W], colour²; rounding below 0 counts as 0."""
        return np.asarray(np.maximum(self.variance.mean(-1), 0.0), np.float32)

    @property
    def squared_error(self) -> NDArray[np.float32]:
        """Return (Ĉ − C)² averaged over the channels [H, W], colour²."""
        return np.asarray(((self.rendered - self.recorded) ** 2).mean(-1), np.float32)

    def scores(self) -> dict[str, float]:
        """Return PSNR (dB), SSIM, depth L1 (m) and the share of readings that the map covers, on valid pixels."""
        valid = self.valid
        covered = float((self.rendered_depth_m > 0)[valid].mean()) if valid.any() else float("nan")
        return {
            "psnr_db": psnr(self.rendered, self.recorded, valid),
            "ssim": ssim(self.rendered, self.recorded, valid),
            "depth_l1_m": depth_l1(self.rendered_depth_m, self.recorded_depth_m),
            "depth_coverage": covered,
        }


@dataclass(frozen=True, eq=False)
class Panel:
    """One picture of a strip: title, uint8 pixels, and either a colour bar (palette, end labels) or a line of text."""

    title: str
    pixels: palette.Rgb
    caption: str = ""
    bar: NDArray[np.float64] | None = None
    ends: tuple[str, str] = ("", "")


def side_by_side(view: View) -> Image.Image:
    """Draw the strip of one view, an RGB picture about 1650 pixels wide."""
    return strip_of(panels_of(view), view.recorded.shape[0] / view.recorded.shape[1])


def strip_of(panels: Sequence[Panel], height_over_width: float) -> Image.Image:
    """Draw panels of one shape side by side, 330 pixels each."""
    height = round(PANEL_WIDTH * height_over_width)
    size = (len(panels) * (PANEL_WIDTH + GAP) + GAP, height + HEAD + FOOT)
    strip = Image.new("RGB", size, BACKGROUND)
    for i, panel in enumerate(panels):
        _draw(strip, panel, GAP + i * (PANEL_WIDTH + GAP), height)
    return strip


def panels_of(view: View) -> list[Panel]:
    """Return the five panels of a view. Uncertainty and error are shown as roots, so that both read as colour steps."""
    depth_range = palette.span(view.recorded_depth_m, view.valid)
    deviation, error = np.sqrt(view.uncertainty), np.sqrt(view.squared_error)
    mapped = view.alpha > COVERED_ALPHA
    score = view.scores()
    return [
        Panel("input", _bytes(view.recorded), " · ".join((f"frame {view.index}", view.kind, *view.notes))),
        Panel("rendered colour", _bytes(view.rendered), f"PSNR {score['psnr_db']:.1f} dB · SSIM {score['ssim']:.3f}"),
        _mapped("rendered depth", view.rendered_depth_m, mapped, depth_range, palette.VIRIDIS, " m"),
        _mapped("uncertainty V, as root", deviation, mapped, _from_zero(deviation, mapped), palette.INFERNO),
        _mapped("error, root mean square", error, view.valid, _from_zero(error, view.valid), palette.INFERNO),
    ]


def _from_zero(values: NDArray[np.float32], valid: NDArray[np.bool_]) -> tuple[float, float]:
    """Return 0 and the 99th percentile."""
    return 0.0, palette.span(values, valid)[1]


def _mapped(
    title: str,
    values: NDArray[np.float32],
    valid: NDArray[np.bool_],
    limits: tuple[float, float],
    colours: NDArray[np.float64],
    unit: str = "",
) -> Panel:
    """Colour a map and label its range."""
    digits = 2 if unit else 3
    ends = (f"{limits[0]:.{digits}f}{unit}", f"{limits[1]:.{digits}f}{unit}")
    return Panel(title, palette.picture(values, valid, *limits, colours), bar=colours, ends=ends)


def _bytes(color: NDArray[np.float32]) -> palette.Rgb:
    """Turn [0, 1] into 0 … 255."""
    return (np.clip(color, 0.0, 1.0) * 255.0).round().astype(np.uint8)


def _draw(strip: Image.Image, panel: Panel, left: int, height: int) -> None:
    """Put one panel into the strip: title above, picture, bar or caption below."""
    draw = ImageDraw.Draw(strip)
    draw.text((left + 2, HEAD // 2), panel.title, TEXT, ImageFont.load_default(18), anchor="lm")
    enlarged = panel.pixels.shape[1] < PANEL_WIDTH
    how = Image.Resampling.NEAREST if enlarged and panel.bar is not None else Image.Resampling.LANCZOS
    strip.paste(Image.fromarray(panel.pixels).resize((PANEL_WIDTH, height), how), (left, HEAD))
    middle = HEAD + height + FOOT // 2
    small = ImageFont.load_default(16)
    if panel.bar is None:
        draw.text((left + 2, middle), panel.caption, FAINT, small, anchor="lm")
        return
    draw.text((left + 2, middle), panel.ends[0], FAINT, small, anchor="lm")
    draw.text((left + PANEL_WIDTH - 2, middle), panel.ends[1], FAINT, small, anchor="rm")
    ramp = palette.colour(np.tile(np.linspace(0.0, 1.0, PANEL_WIDTH - 160), (10, 1)), 0.0, 1.0, panel.bar)
    strip.paste(Image.fromarray(ramp), (left + 80, middle - 5))
