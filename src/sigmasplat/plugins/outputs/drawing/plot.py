"""Draw line charts as SVG, in colours for a light and a dark page."""

from dataclasses import dataclass
from html import escape

import numpy as np

from sigmasplat.api import Matrix

Colour = tuple[int, int, int]
WIDTH, HEIGHT = 460, 300
LEFT, TOP, RIGHT, BOTTOM = 58.0, 46.0, 446.0, 256.0
"""Ends of the axes, in units of the SVG."""
ACCENT, BLUE, GREEN, PURPLE, FAINT = range(5)
"""Indices into `LIGHT` and `DARK`."""
LIGHT: tuple[Colour, ...] = ((214, 90, 30), (40, 110, 190), (60, 150, 90), (130, 90, 170), (152, 160, 170))
DARK: tuple[Colour, ...] = ((255, 140, 70), (100, 170, 250), (110, 200, 140), (190, 150, 230), (112, 120, 130))
MOST = 1e100
"""Values that are not smaller are not drawn."""


def _colours(colours: tuple[Colour, ...], text: str, grid: str) -> str:
    own = "".join(f"--c{k}: rgb({r} {g} {b}); " for k, (r, g, b) in enumerate(colours))
    return f".chart {{ {own}--text: {text}; --grid: {grid} }}"


STYLE = f"""{_colours(LIGHT, "#464e58", "#e2e5e9")}
@media (prefers-color-scheme: dark) {{ {_colours(DARK, "#b0b8c2", "#343941")} }}
.chart text {{ font: 12px system-ui, sans-serif; fill: var(--text) }} .chart .title {{ font-size: 15px }}
.chart path {{ fill: none; stroke-linecap: round; stroke-linejoin: round }} .chart .grid {{ stroke: var(--grid) }}"""


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

    `square`: both axes have the same scale; y_limits: ends of the y axis (default: from the curves).
    """

    title: str
    x_label: str
    y_label: str
    curves: list[Curve]
    square: bool = False
    y_limits: tuple[float, float] | None = None


def svg(chart: Chart) -> str:
    """Return a chart as one SVG element, which is also a whole file."""
    low, high = _limits(chart)

    def place(points: Matrix) -> Matrix:
        return np.asarray([LEFT, BOTTOM] + (points - low) / (high - low) * [RIGHT - LEFT, TOP - BOTTOM])

    curves = (_path(curve, place(_drawable(curve.points))) for curve in chart.curves)
    parts = [f"<style>{STYLE}</style>", *_grid(chart, low, high), *_head(chart), *curves]
    size = f"viewBox='0 0 {WIDTH} {HEIGHT}' width='{WIDTH}' height='{HEIGHT}'"
    head = f"<svg class='chart' xmlns='http://www.w3.org/2000/svg' {size} role='img'>"
    return f"{head}<title>{escape(chart.title)}</title>{''.join(parts)}</svg>"


def nice_ticks(low: float, high: float, wanted: int = 5) -> Matrix:
    """Return about `wanted` round numbers inside [low, high]; their step is 1, 2 or 5 times a power of ten."""
    raw = (high - low) / wanted
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * min((1.0, 2.0, 5.0, 10.0), key=lambda m: abs(m * power - raw))
    return np.asarray(np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step)


def _drawable(points: Matrix) -> Matrix:
    """Return the points [N, 2] that are finite, and so small that differences and squares of them are finite too."""
    return points[(np.abs(points) < MOST).all(1)]


def _limits(chart: Chart) -> tuple[Matrix, Matrix]:
    """Return the range of both axes (low [2], high [2]) with a small margin; if `square`, with the same scale."""
    points = _drawable(np.concatenate([curve.points for curve in chart.curves]))
    if not len(points):
        return np.zeros(2), np.ones(2)
    low, high = points.min(0), points.max(0)
    margin = np.maximum(0.06 * (high - low), np.maximum(1e-3, 1e-9 * np.abs(high)))
    low, high = low - margin, high + margin
    if chart.y_limits is not None:
        low[1], high[1] = chart.y_limits
    if chart.square:
        size = np.array([RIGHT - LEFT, BOTTOM - TOP])
        half = 0.5 * size * ((high - low) / size).max()
        middle = 0.5 * (low + high)
        low, high = middle - half, middle + half
    return low, high


def _path(curve: Curve, places: Matrix) -> str:
    """Return one curve through places of the SVG. A dot is a line of no length; so is a single point."""
    steps = [f"{x:.1f},{y:.1f}" for x, y in places]
    alone = curve.dots or len(steps) == 1
    drawn = "".join(f"M{step}h0" for step in steps) if alone else f"M{' '.join(steps)}" if steps else ""
    return f"<path d='{drawn}' stroke='var(--c{curve.colour})' stroke-width='{6.0 if alone else curve.width:g}'/>"


def _text(x: float, y: float, words: str, **attributes: str) -> str:
    more = "".join(f" {name.replace('_', '-')}='{value}'" for name, value in attributes.items())
    return f"<text x='{x:.1f}' y='{y:.1f}'{more}>{escape(words)}</text>"


def _grid(chart: Chart, low: Matrix, high: Matrix) -> list[str]:
    """Return grid lines with their numbers, and the label of the x axis."""
    parts = []
    for value in nice_ticks(low[0], high[0]):
        x = LEFT + (value - low[0]) / (high[0] - low[0]) * (RIGHT - LEFT)
        parts.append(f"<path class='grid' d='M{x:.1f},{TOP}V{BOTTOM}'/>")
        parts.append(_text(x, BOTTOM + 16, f"{value + 0.0:g}", text_anchor="middle"))
    for value in nice_ticks(low[1], high[1]):
        y = BOTTOM - (value - low[1]) / (high[1] - low[1]) * (BOTTOM - TOP)
        parts.append(f"<path class='grid' d='M{LEFT},{y:.1f}H{RIGHT}'/>")
        parts.append(_text(LEFT - 6, y + 4, f"{value + 0.0:g}", text_anchor="end"))
    return [*parts, _text((LEFT + RIGHT) / 2, BOTTOM + 36, chart.x_label, text_anchor="middle")]


def _head(chart: Chart) -> list[str]:
    """Return the title; below it the label of the y axis, and the legend if there are several curves."""
    named = [curve for curve in chart.curves if curve.name] if len(chart.curves) > 1 else []
    legend = "".join(f"<tspan dx='12' fill='var(--c{c.colour})'>● {escape(c.name)}</tspan>" for c in named)
    y_label = f"<text x='{LEFT}' y='36'>{escape(chart.y_label)}{legend}</text>"
    return [f"<text class='title' x='{LEFT}' y='18'>{escape(chart.title)}</text>", y_label]
