"""Draw the images of a film: colour, depth and uncertainty side by side, with a legend strip below."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from sigmasplat.api import Render
from sigmasplat.plugins.evaluation.metrics.views import COVERED_ALPHA
from sigmasplat.plugins.outputs.drawing import colormap
from sigmasplat.plugins.outputs.drawing.view_panels import BACKGROUND, FAINT, TEXT

STRIP, MARGIN, GAP = 40, 10, 8
SHORTEST_BAR = 60
"""A colour bar shorter than this, in pixels, is drawn below its label; below half of it, its numbers are left out."""
Font = ImageFont.ImageFont | ImageFont.FreeTypeFont

Floats = NDArray[np.float32]
Limits = tuple[float, float]


@dataclass(frozen=True, eq=False)
class FilmMaps:
    """Maps of one render: color [H, W, 3] in [0, 1]; depth_m and deviation √V [H, W]; mapped: pixels with a surface."""

    color: Floats
    depth_m: Floats
    deviation: Floats
    mapped: NDArray[np.bool_]

    @staticmethod
    def of(seen: Render) -> "FilmMaps":
        """Compute the maps of a render: depth Σwz / Σw; deviation √V, with V averaged over the channels."""
        alpha = np.asarray(seen.alpha.cpu(), np.float32)
        depth_m = np.asarray(seen.depth.cpu() / seen.alpha.cpu().clamp(min=COVERED_ALPHA), np.float32)
        variance = np.asarray(seen.variance.cpu(), np.float32).mean(-1)
        color = np.asarray(seen.color.cpu().clamp(0.0, 1.0), np.float32)
        return FilmMaps(color, depth_m, np.sqrt(np.maximum(variance, 0.0)), alpha > COVERED_ALPHA)


@dataclass(frozen=True)
class FilmScale:
    """The colour ranges of a whole film: depth in metres, deviation of colour."""

    depth_m: Limits
    deviation: Limits

    @staticmethod
    def of(samples: Sequence[FilmMaps]) -> "FilmScale":
        """Choose the ranges from sample images: 1st to 99th percentile of depth, 0 to the 99th of deviation."""
        mapped = np.concatenate([maps.mapped.ravel() for maps in samples])
        depth_m = np.concatenate([maps.depth_m.ravel() for maps in samples])
        deviation = np.concatenate([maps.deviation.ravel() for maps in samples])
        return FilmScale(colormap.value_range(depth_m, mapped), (0.0, colormap.value_range(deviation, mapped)[1]))


def color_bytes(maps: FilmMaps) -> colormap.Rgb:
    """Return the colours as uint8 [H, W, 3]."""
    return np.asarray(np.rint(maps.color * 255.0).astype(np.uint8))


def film_image(maps: FilmMaps, scale: FilmScale, strip: colormap.Rgb) -> colormap.Rgb:
    """Draw one image: three panels with the legend strip below, uint8 [H + strip, 3 W, 3]."""
    panels = [
        color_bytes(maps),
        colormap.apply_masked(maps.depth_m, maps.mapped, *scale.depth_m, colormap.VIRIDIS),
        colormap.apply_masked(maps.deviation, maps.mapped, *scale.deviation, colormap.INFERNO),
    ]
    return np.concatenate([np.concatenate(panels, axis=1), strip])


def legend_strip(scale: FilmScale, width: int) -> colormap.Rgb:
    """Draw the legend strip of a film whose panels are `width` pixels wide, uint8 [strip, 3 width, 3].

    For narrow panels the labels are above the colour bars; labels that still do not fit are left out.
    """
    strip = Image.new("RGB", (3 * width, STRIP), BACKGROUND)
    draw, font = ImageDraw.Draw(strip), ImageFont.load_default(max(11, min(15, width // 20)))
    words = ("colour", "depth", "uncertainty")
    ends = (("", ""), (f"{scale.depth_m[0]:.1f}", f"{scale.depth_m[1]:.1f} m"), ("0", f"{scale.deviation[1]:.2f}"))
    margin = min(MARGIN, width // 16)
    room = width - 2 * margin

    def bar_px(*texts: str) -> int:
        return int(room - sum(draw.textlength(text, font) + GAP for text in texts))

    together = all(bar_px(word, low, high) >= SHORTEST_BAR for word, (low, high) in zip(words, ends, strict=True))
    above, level = (STRIP // 2, STRIP // 2) if together else (STRIP // 4 + 1, STRIP * 3 // 4 - 1)
    maps = (None, colormap.VIRIDIS, colormap.INFERNO)
    for k, (word, (low, high), colours) in enumerate(zip(words, ends, maps, strict=True)):
        left = k * width + margin
        if draw.textlength(word, font) <= room:
            draw.text((left, above), word, TEXT, font, anchor="lm")
        if colours is not None:
            taken = draw.textlength(word, font) + GAP if together else 0.0
            numbers = together or bar_px(low, high) >= SHORTEST_BAR // 2
            _bar(strip, font, (left + taken, left + room), level, (low, high) if numbers else ("", ""), colours)
    draw.line((0, 0, 3 * width, 0), FAINT)
    return np.asarray(strip)


def _bar(
    strip: Image.Image, font: Font, span: tuple[float, float], level: int, ends: tuple[str, str],
    colours: NDArray[np.float64],
) -> None:  # fmt: skip
    """Draw a colour bar between its two labels, from pixel `span[0]` to `span[1]`, in row `level`."""
    draw, (left, right) = ImageDraw.Draw(strip), span
    for text, at, anchor in zip(ends, span, ("lm", "rm"), strict=True):
        draw.text((at, level), text, TEXT, font, anchor=anchor)
    before, after = (draw.textlength(text, font) + GAP if text else 0.0 for text in ends)
    ramp = colormap.apply(
        np.tile(np.linspace(0.0, 1.0, int(right - after - left - before)), (10, 1)), 0.0, 1.0, colours
    )
    strip.paste(Image.fromarray(ramp), (int(left + before), level - 5))
