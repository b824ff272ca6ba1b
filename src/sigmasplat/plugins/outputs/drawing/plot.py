"""Draw line charts with PIL, for a light and a dark page."""

from dataclasses import dataclass, field

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sigmasplat.api import Matrix

Colour = tuple[int, int, int]
Box = tuple[float, float, float, float]

DRAW_SCALE = 2
"""Pictures are drawn this many times larger and then reduced, because PIL does not smooth lines."""
SIZE = (1040, 430)
NARROW_SIZE = (376, 300)
"""Size of one chart on a page as narrow as a phone."""
ACCENT, BLUE, GREEN, PURPLE, FAINT = range(5)
"""Indices into `Theme.curves`."""
MOST = 1e100
"""Values that are not smaller are not drawn."""


@dataclass(frozen=True)
class Theme:
    """Colours of a plot on a light or a dark page."""

    name: str
    background: Colour
    text: Colour
    grid: Colour
    curves: tuple[Colour, ...]


LIGHT = Theme(
    "light", (255, 255, 255), (70, 78, 88), (226, 229, 233),
    ((214, 90, 30), (40, 110, 190), (60, 150, 90), (130, 90, 170), (152, 160, 170)),
)  # fmt: skip
DARK = Theme(
    "dark", (24, 27, 32), (176, 184, 194), (52, 57, 65),
    ((255, 140, 70), (100, 170, 250), (110, 200, 140), (190, 150, 230), (112, 120, 130)),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Curve:
    """A line through points [N, 2] (x, y), or dots. A curve without a name is not in the legend."""

    name: str
    points: Matrix
    colour: int
    dots: bool = False
    width: float = 2.0


@dataclass(frozen=True, eq=False)
class Chart:
    """Curves on one pair of axes.

    `square`: both axes have the same scale; `from_zero`: the y axis starts at 0; labels: texts beside points;
    y_limits: ends of the y axis (default: from the curves).
    """

    title: str
    x_label: str
    y_label: str
    curves: list[Curve]
    square: bool = False
    from_zero: bool = False
    labels: dict[str, tuple[float, float]] = field(default_factory=dict)
    y_limits: tuple[float, float] | None = None


def draw_charts(charts: list[Chart], theme: Theme, size: tuple[int, int] = SIZE) -> Image.Image:
    """Draw charts side by side on one picture of `size` pixels."""
    width, height = size[0] * DRAW_SCALE, size[1] * DRAW_SCALE
    image = Image.new("RGB", (width, height), theme.background)
    share = width / len(charts)
    for i, chart in enumerate(charts):
        _draw_chart(ImageDraw.Draw(image), chart, theme, (i * share, 0.0, (i + 1) * share, float(height)))
    return image.resize(size, Image.Resampling.LANCZOS)


def draw_narrow_charts(charts: list[Chart], theme: Theme) -> Image.Image:
    """Draw charts one below the other on one picture, each of `NARROW_SIZE` pixels."""
    width, height = NARROW_SIZE
    image = Image.new("RGB", (width, height * len(charts)), theme.background)
    for i, chart in enumerate(charts):
        image.paste(draw_charts([chart], theme, NARROW_SIZE), (0, i * height))
    return image


def nice_ticks(low: float, high: float, wanted: int = 5) -> Matrix:
    """Return about `wanted` round numbers inside [low, high]; their step is 1, 2 or 5 times a power of ten."""
    raw = (high - low) / wanted
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * min((1.0, 2.0, 5.0, 10.0), key=lambda m: abs(m * power - raw))
    return np.asarray(np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step)


def _drawable(points: Matrix) -> Matrix:
    """Return the points [N, 2] that are finite, and so small that differences and squares of them are finite too."""
    return points[(np.abs(points) < MOST).all(1)]


def _limits(chart: Chart, box: Box) -> tuple[Matrix, Matrix]:
    """Return the range of both axes (low [2], high [2]) with a small margin; if `square`, with the same scale."""
    points = _drawable(np.concatenate([curve.points for curve in chart.curves]))
    if not len(points):
        return np.zeros(2), np.ones(2)
    low, high = points.min(0), points.max(0)
    if chart.from_zero:
        low[1] = min(low[1], 0.0)
    margin = np.maximum(0.06 * (high - low), np.maximum(1e-3, 1e-9 * np.abs(high)))
    low, high = low - margin * (0.0 if chart.from_zero else 1.0), high + margin
    if chart.y_limits is not None:
        low[1], high[1] = chart.y_limits
    if chart.square:
        pixels = np.array([box[2] - box[0], box[3] - box[1]])
        half = 0.5 * pixels * ((high - low) / pixels).max()
        middle = 0.5 * (low + high)
        low, high = middle - half, middle + half
    return low, high


def _draw_chart(draw: ImageDraw.ImageDraw, chart: Chart, theme: Theme, cell: Box) -> None:
    """Draw the title, grid, curves and legend of one chart in its cell."""
    s = DRAW_SCALE
    box = (cell[0] + 64 * s, cell[1] + 48 * s, cell[2] - 20 * s, cell[3] - 52 * s)
    low, high = _limits(chart, box)

    def place(points: Matrix) -> list[tuple[float, float]]:
        unit = (points - low) / (high - low)
        return [(box[0] + u * (box[2] - box[0]), box[3] - v * (box[3] - box[1])) for u, v in unit]

    _draw_grid(draw, chart, theme, box, (low, high))
    for curve in chart.curves:
        _draw_curve(draw, curve, place(_drawable(curve.points)), theme)
    font = ImageFont.load_default(13 * s)
    for text, point in chart.labels.items():
        x, y = place(np.array([point]))[0]
        draw.text((x + 6 * s, y - 6 * s), text, theme.text, font, anchor="ls")
    _draw_head(draw, chart, theme, box, cell[1] + 24 * s)


def _draw_curve(draw: ImageDraw.ImageDraw, curve: Curve, places: list[tuple[float, float]], theme: Theme) -> None:
    """Draw one curve through pixel positions; a single point becomes a dot."""
    s, colour = DRAW_SCALE, theme.curves[curve.colour]
    if curve.dots or len(places) == 1:
        for x, y in places:
            draw.ellipse((x - 3 * s, y - 3 * s, x + 3 * s, y + 3 * s), fill=colour)
    elif places:
        draw.line(places, colour, round(curve.width * s), joint="curve")


def _draw_grid(draw: ImageDraw.ImageDraw, chart: Chart, theme: Theme, box: Box, limits: tuple[Matrix, Matrix]) -> None:
    """Draw grid lines with their numbers, and the label of the x axis."""
    s, (low, high) = DRAW_SCALE, limits
    font = ImageFont.load_default(13 * s)
    for x in nice_ticks(low[0], high[0]):
        at = box[0] + (x - low[0]) / (high[0] - low[0]) * (box[2] - box[0])
        draw.line((at, box[1], at, box[3]), theme.grid, s)
        draw.text((at, box[3] + 8 * s), f"{x + 0.0:g}", theme.text, font, anchor="mt")
    for y in nice_ticks(low[1], high[1]):
        at = box[3] - (y - low[1]) / (high[1] - low[1]) * (box[3] - box[1])
        draw.line((box[0], at, box[2], at), theme.grid, s)
        draw.text((box[0] - 8 * s, at), f"{y + 0.0:g}", theme.text, font, anchor="rm")
    draw.text(((box[0] + box[2]) / 2, box[3] + 30 * s), chart.x_label, theme.text, font, anchor="mt")


def _draw_head(draw: ImageDraw.ImageDraw, chart: Chart, theme: Theme, box: Box, middle: float) -> None:
    """Draw the title and the label of the y axis on the left, the legend on the right; on two lines if they overlap."""
    s = DRAW_SCALE
    title, font = ImageFont.load_default(17 * s), ImageFont.load_default(14 * s)
    named = [curve for curve in chart.curves if curve.name] if len(chart.curves) > 1 else []
    after = box[0] + draw.textlength(chart.title, title) + 10 * s
    legend_left = box[2] - sum(draw.textlength(curve.name, font) + 40 * s for curve in named)
    first, second = middle, middle
    if legend_left < after + draw.textlength(chart.y_label, font):
        first, second, after = middle - 11 * s, middle + 10 * s, box[0]
    draw.text((box[0], first), chart.title, theme.text, title, anchor="lm")
    draw.text((after, second), chart.y_label, theme.text, font, anchor="lm")
    right = box[2]
    for curve in reversed(named):
        draw.text((right, second), curve.name, theme.text, font, anchor="rm")
        right -= draw.textlength(curve.name, font) + 8 * s
        draw.line((right - 16 * s, second, right, second), theme.curves[curve.colour], 3 * s)
        right -= 32 * s
