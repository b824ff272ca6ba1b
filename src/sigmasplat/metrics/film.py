"""Lay out a film's images: colour, depth and uncertainty side by side over a strip that says what the colours mean."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from sigmasplat.metrics import palette
from sigmasplat.metrics.panels import BACKGROUND, COVERED_ALPHA, FAINT, TEXT
from sigmasplat.render import Render

STRIP, MARGIN = 40, 10

Floats = NDArray[np.float32]
Limits = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Maps:
    """What a film shows of a render: color [H, W, 3] in [0, 1]; depth_m, deviation √V [H, W]; where there is a map."""

    color: Floats
    depth_m: Floats
    deviation: Floats
    mapped: NDArray[np.bool_]

    @staticmethod
    def of(seen: Render) -> "Maps":
        """Take the maps out of a render: depth Σwz / Σw; V averaged over the channels, as its root."""
        alpha = np.asarray(seen.alpha.cpu(), np.float32)
        depth_m = np.asarray(seen.depth.cpu() / seen.alpha.cpu().clamp(min=COVERED_ALPHA), np.float32)
        variance = np.asarray(seen.variance.cpu(), np.float32).mean(-1)
        color = np.asarray(seen.color.cpu().clamp(0.0, 1.0), np.float32)
        return Maps(color, depth_m, np.sqrt(np.maximum(variance, 0.0)), alpha > COVERED_ALPHA)


@dataclass(frozen=True)
class Scale:
    """The ends of a whole film's colours: depth in metres, deviation of colour."""

    depth_m: Limits
    deviation: Limits

    @staticmethod
    def of(samples: Sequence[Maps]) -> "Scale":
        """Fit the scale to some of a film's images: 1st to 99th percentile of depth, 0 to the 99th of deviation."""
        mapped = np.concatenate([maps.mapped.ravel() for maps in samples])
        depth_m = np.concatenate([maps.depth_m.ravel() for maps in samples])
        deviation = np.concatenate([maps.deviation.ravel() for maps in samples])
        return Scale(palette.span(depth_m, mapped), (0.0, palette.span(deviation, mapped)[1]))


def film_image(maps: Maps, scale: Scale, strip: palette.Rgb) -> palette.Rgb:
    """Lay out one image: three panels and the strip under them, uint8 [H + strip, 3 W, 3]."""
    panels = [
        np.rint(maps.color * 255.0).astype(np.uint8),
        palette.picture(maps.depth_m, maps.mapped, *scale.depth_m, palette.VIRIDIS),
        palette.picture(maps.deviation, maps.mapped, *scale.deviation, palette.INFERNO),
    ]
    return np.concatenate([np.concatenate(panels, axis=1), strip])


def legend_strip(scale: Scale, width: int) -> palette.Rgb:
    """Draw what is under every image of a film whose panels are `width` pixels wide, uint8 [strip, 3 width, 3]."""
    strip = Image.new("RGB", (3 * width, STRIP), BACKGROUND)
    font = ImageFont.load_default(max(10, min(15, width // 20)))
    draw = ImageDraw.Draw(strip)
    draw.text((MARGIN, STRIP // 2), "colour", TEXT, font, anchor="lm")
    low, high = scale.depth_m
    _bar(strip, font, (width, width), f"depth {low:.1f}", f"{high:.1f} m", palette.VIRIDIS)
    _bar(strip, font, (2 * width, width), "uncertainty 0", f"{scale.deviation[1]:.2f}", palette.INFERNO)
    draw.line((0, 0, 3 * width, 0), FAINT)
    return np.asarray(strip)


def _bar(
    strip: Image.Image, font: ImageFont.ImageFont | ImageFont.FreeTypeFont, at: tuple[int, int], low: str, high: str,
    colours: NDArray[np.float64],
) -> None:  # fmt: skip
    """Draw a colour bar between its ends in words, from pixel `at[0]` on, `at[1]` wide."""
    draw, middle = ImageDraw.Draw(strip), STRIP // 2
    left, right = at[0] + MARGIN, at[0] + at[1] - MARGIN
    draw.text((left, middle), low, TEXT, font, anchor="lm")
    draw.text((right, middle), high, TEXT, font, anchor="rm")
    first, last = left + draw.textlength(low, font) + 8, right - draw.textlength(high, font) - 8
    if last - first >= 8:
        ramp = palette.colour(np.tile(np.linspace(0.0, 1.0, int(last - first)), (10, 1)), 0.0, 1.0, colours)
        strip.paste(Image.fromarray(ramp), (int(first), middle - 5))
