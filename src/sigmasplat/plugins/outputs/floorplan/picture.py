"""Draw a floor plan: what is there, the uncertainty of colour and depth, and where to scan again."""

import textwrap
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from sigmasplat.api import Progress, RunError, no_progress, replacing, write_json
from sigmasplat.plugins.outputs.drawing import colormap
from sigmasplat.plugins.outputs.drawing.plot import (
    ACCENT,
    BLUE,
    DRAW_SCALE,
    GREEN,
    LIGHT,
    PURPLE,
    Colour,
    Theme,
    nice_ticks,
)
from sigmasplat.plugins.outputs.floorplan.floor_plan import (
    CELL_M,
    FLOOR_UNOBSERVED,
    FREE,
    OBJECT,
    UNOBSERVED,
    WALL,
    FloorPlan,
    run_floor_plan,
)
from sigmasplat.plugins.outputs.floorplan.ground import WRONG_BY
from sigmasplat.plugins.outputs.floorplan.rescan import unsure_rule
from sigmasplat.plugins.outputs.run_reader import RunReader

PANEL_PX = 440
"""The longer side of a panel."""
NARROW_PX, NARROW_TALLEST = 376, 1.3
"""Width of a panel on a phone, and the largest height relative to this width."""
GAP, NARROW_GAP, HEAD, FOOT, LINE = 24, 12, 40, 44, 24
MIN_WIDTH, DOT, INDENT, RULE_COLUMNS = 760, 9, 28, 100
REASON_COLOURS = {"unseen": BLUE, "thin": PURPLE, "unsure": ACCENT}
UNOBSERVED_SHADE, OBJECT_SHADE, FLOOR_UNOBSERVED_SHADE = 0.14, 0.45, 0.2
"""Share of the text colour that is mixed into the background, for the first two; the last is the share of blue."""

Corner = tuple[int, int]
Floats = NDArray[np.float32]


def draw_floor_plan(plan: FloorPlan, theme: Theme = LIGHT, *, list_regions: bool = True) -> Image.Image:
    """Draw a plan, y upwards: three panels side by side, or one below the other if the plan is wide.

    With `list_regions` the regions to scan again are listed below the panels.
    """
    return _drawn(_Sheet(plan, theme, _wide_layout(plan), list_regions))


def draw_narrow_floor_plan(plan: FloorPlan, theme: Theme = LIGHT) -> Image.Image:
    """Draw a plan for a page as narrow as a phone: three panels one below the other, without the list of regions."""
    return _drawn(_Sheet(plan, theme, _narrow_layout(plan), False))


def export_plan(
    reader: RunReader, target: Path, *, cell_m: float = CELL_M, progress: Progress = no_progress
) -> FloorPlan:
    """Write the image (.png) and the data of the plan beside it (.json); return the plan.

    Calls `progress(done, total)` for each rendered view. Raises RunError on another ending, without a map or path, or
    if a file cannot be written; ConfigError unless 1 mm ≤ cell_m ≤ 1 m.
    """
    if target.suffix.lower() != ".png":
        raise RunError(f"cannot write a floor plan as {target.name}; give a name that ends in .png")
    plan = run_floor_plan(reader.run, reader.valid_path(), reader.camera, cell_m=cell_m, progress=progress)
    write_plan(plan, target)
    return plan


def write_plan(plan: FloorPlan, target: Path) -> None:
    """Write the image to `target` (.png) and the data beside it (.json).

    Raises RunError if a file cannot be written.
    """
    picture = draw_floor_plan(plan)
    with replacing(target) as temporary:
        picture.save(temporary, "PNG")
    write_json(target.with_suffix(".json"), plan.record())


def _drawn(sheet: "_Sheet") -> Image.Image:
    """Draw all parts of a plan."""
    plan, theme = sheet.plan, sheet.theme
    depth_high, (color, title, color_high, color_end) = _scale_end(plan.depth_sigma_m), _color_values(plan)
    sheet.panel(0, draw_kinds(plan, theme), "What is there")
    sheet.panel(1, _draw_values(plan, color, color_high, theme), title)
    sheet.panel(2, _draw_values(plan, plan.depth_sigma_m, depth_high, theme), "Depth: standard deviation")
    sheet.scale()
    sheet.bar(1, color_end)
    sheet.bar(2, f"{100.0 * depth_high:.2g} cm")
    sheet.path()
    sheet.region_circles()
    sheet.legend()
    if sheet.list_regions:
        sheet.region_list()
    return sheet.finished()


def _color_values(plan: FloorPlan) -> tuple[Floats, str, float, str]:
    """Return what the panel of colour shows: values of the cells, title, end of the scale and its label."""
    if plan.wrong_share is None:
        high = _scale_end(plan.color_sigma)
        return plan.color_sigma, "Colour: standard deviation", high, f"{high:.2g}"
    high = _scale_end(plan.wrong_share)
    return plan.wrong_share, f"Colour: pixels wrong by > {WRONG_BY:g}", high, f"{100.0 * high:.0f} %"


def draw_kinds(plan: FloorPlan, theme: Theme) -> colormap.Rgb:
    """Colour the cells by their kind, uint8 [rows, columns, 3]; row 0 is at the lowest y."""
    shades = np.array([_shades(theme)[kind] for kind in range(WALL + 1)], np.uint8)
    return np.asarray(shades[plan.kind])


def _shades(theme: Theme) -> dict[int, Colour]:
    """Return the colour of each kind of cell."""
    return {
        UNOBSERVED: _mix(theme, UNOBSERVED_SHADE, theme.text),
        FLOOR_UNOBSERVED: _mix(theme, FLOOR_UNOBSERVED_SHADE, theme.curves[BLUE]),
        FREE: theme.background,
        OBJECT: _mix(theme, OBJECT_SHADE, theme.text),
        WALL: theme.text,
    }


def _mix(theme: Theme, share: float, towards: Colour) -> Colour:
    """Return a shade between the background and another colour."""
    r, g, b = (round(a + share * (c - a)) for a, c in zip(theme.background, towards, strict=True))
    return r, g, b


def _draw_values(plan: FloorPlan, values: Floats, high: float, theme: Theme) -> colormap.Rgb:
    """Colour the cells by a measurement from 0 to `high`. Cells without one are background, or shaded if unobserved."""
    known = np.isfinite(values)
    out = colormap.apply_masked(np.where(known, values, 0.0), known, 0.0, high, colormap.INFERNO)
    out[~known] = theme.background
    out[~known & (plan.kind == UNOBSERVED)] = _shades(theme)[UNOBSERVED]
    return out


def _scale_end(values: Floats) -> float:
    """Return the end of a colour scale: the 99th percentile."""
    return max(colormap.value_range(values, np.isfinite(values))[1], 1e-6)


def _font(size: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(size * DRAW_SCALE)


def _text_width(words: str, size: int) -> float:
    return _font(size).getlength(words) / DRAW_SCALE


@dataclass(frozen=True)
class _Layout:
    """Sizes in pixels: margin, size of a cell, smallest width of the picture; `stacked`: panels one below the other."""

    gap: int
    cell_px: float
    stacked: bool
    min_width: int


def _wide_layout(plan: FloorPlan) -> _Layout:
    rows, columns = plan.kind.shape
    return _Layout(GAP, max(1, round(PANEL_PX / max(rows, columns))), columns > 1.6 * rows, MIN_WIDTH)


def _narrow_layout(plan: FloorPlan) -> _Layout:
    rows, columns = plan.kind.shape
    cell_px = min(NARROW_PX / columns, NARROW_TALLEST * NARROW_PX / rows)
    return _Layout(NARROW_GAP, cell_px, True, NARROW_PX + 2 * NARROW_GAP)


class _Sheet:
    """The picture being drawn, at `DRAW_SCALE` times its final size. Positions are in pixels of the final picture."""

    def __init__(self, plan: FloorPlan, theme: Theme, layout: _Layout, list_regions: bool) -> None:
        """Make an empty picture with room for the panels, the legend and the list of regions."""
        self.plan, self.theme, self.list_regions = plan, theme, list_regions
        self.gap, self.cell_px, self.stacked = layout.gap, layout.cell_px, layout.stacked
        rows, columns = plan.kind.shape
        self.width, self.height = round(columns * self.cell_px), round(rows * self.cell_px)
        across, down = (1, 3) if self.stacked else (3, 1)
        self.below = down * (HEAD + self.height + FOOT) + GAP // 2
        self.listed = self._listed() if list_regions else []
        widest = max((_text_width(words, 14) for words in self.listed), default=0.0) + INDENT + 2 * self.gap
        total_width = max(across * (self.width + self.gap) + self.gap, layout.min_width, round(widest))
        self.legend_rows = self._legend_rows(total_width)
        lines = len(self.legend_rows) + (2 + len(self.listed) if list_regions else 0)
        size = (total_width, self.below + lines * LINE)
        self.image = Image.new("RGB", (size[0] * DRAW_SCALE, size[1] * DRAW_SCALE), theme.background)
        self.pen = ImageDraw.Draw(self.image)

    def _listed(self) -> list[str]:
        """Return the lines of the list of regions: the regions, then the rule for unsure ones."""
        regions = [region.sentence("sq m") for region in self.plan.regions]
        return [
            *(regions or ["No regions: everything was observed, and the map is certain."]),
            *textwrap.wrap(unsure_rule(self.plan.predicted_errors), RULE_COLUMNS),
        ]

    def _legend_rows(self, total_width: int) -> list[list[tuple[str, Colour]]]:
        """Break the entries of the legend into lines."""
        shades = _shades(self.theme)
        entries = [
            ("not observed", shades[UNOBSERVED]),
            (f"floor not observed, {self.plan.area_m2(FLOOR_UNOBSERVED):.1f} sq m", shades[FLOOR_UNOBSERVED]),
            (f"free floor, {self.plan.area_m2(FREE):.1f} sq m", shades[FREE]),
            ("objects", shades[OBJECT]), ("walls", shades[WALL]), ("camera path", self.theme.curves[GREEN]),
        ]  # fmt: skip
        lines: list[list[tuple[str, Colour]]] = [[]]
        x = float(self.gap)
        for words, colour in entries:
            wide = 18 + _text_width(words, 13)
            if lines[-1] and x + wide > total_width - self.gap:
                lines.append([])
                x = float(self.gap)
            lines[-1].append((words, colour))
            x += wide + 18
        return lines

    def finished(self) -> Image.Image:
        """Return the picture at its final size."""
        size = (self.image.width // DRAW_SCALE, self.image.height // DRAW_SCALE)
        return self.image.resize(size, Image.Resampling.LANCZOS)

    def corner(self, number: int) -> Corner:
        """Return the upper left corner of the cells of a panel."""
        right, down = (0, number) if self.stacked else (number, 0)
        return self.gap + right * (self.width + self.gap), HEAD + down * (HEAD + self.height + FOOT)

    def position(self, number: int, x_m: float, y_m: float) -> tuple[float, float]:
        """Return the position of a point of the floor in a panel."""
        (left, top), (x, y) = self.corner(number), (np.array([x_m, y_m]) - self.plan.origin_m) / self.plan.cell_m
        return left + float(x) * self.cell_px, top + self.height - float(y) * self.cell_px

    def text(self, x: float, y: float, words: str, size: int, anchor: str = "lm", fill: Colour | None = None) -> float:
        """Write a text, and return its width."""
        font = _font(size)
        self.pen.text((x * DRAW_SCALE, y * DRAW_SCALE), words, fill or self.theme.text, font, anchor=anchor)
        return _text_width(words, size)

    def box(self, left: float, top: float, right: float, bottom: float, fill: Colour | None) -> None:
        """Draw a rectangle with a thin edge."""
        corners = [value * DRAW_SCALE for value in (left, top, right, bottom)]
        self.pen.rectangle(corners, fill=fill, outline=self.theme.grid, width=DRAW_SCALE)

    def circle(self, x: float, y: float, radius: float, colour: Colour, filled: bool) -> None:
        """Draw a circle or a dot."""
        corners = [value * DRAW_SCALE for value in (x - radius, y - radius, x + radius, y + radius)]
        self.pen.ellipse(corners, fill=colour if filled else None, outline=colour, width=2 * DRAW_SCALE)

    def panel(self, number: int, cells: colormap.Rgb, title: str) -> None:
        """Draw the cells of a panel, y upwards, with its title above."""
        (left, top), size = self.corner(number), (self.width * DRAW_SCALE, self.height * DRAW_SCALE)
        picture = Image.fromarray(np.ascontiguousarray(cells[::-1])).resize(size, Image.Resampling.NEAREST)
        self.image.paste(picture, (left * DRAW_SCALE, top * DRAW_SCALE))
        self.box(left, top, left + self.width, top + self.height, None)
        self.text(left, top - HEAD / 2, title, 17)

    def bar(self, number: int, end: str) -> None:
        """Draw a colour bar, labelled 0 and `end`, below a panel."""
        left, top = self.corner(number)
        width, middle = min(220, self.width // 2), top + self.height + FOOT // 2
        ramp = np.tile(np.linspace(0.0, 1.0, width * DRAW_SCALE), (10 * DRAW_SCALE, 1))
        picture = Image.fromarray(colormap.apply(ramp, 0.0, 1.0, colormap.INFERNO))
        self.image.paste(picture, ((left + 16) * DRAW_SCALE, (middle - 5) * DRAW_SCALE))
        self.text(left, middle, "0", 13)
        self.text(left + 22 + width, middle, end, 13)

    def scale(self) -> None:
        """Draw a scale bar of a round number of metres below the first panel."""
        left, top = self.corner(0)
        middle, px_per_m = top + self.height + FOOT / 2, self.cell_px / self.plan.cell_m
        metres = float(nice_ticks(0.0, 0.4 * self.width / px_per_m, 2)[-1])
        right = left + metres * px_per_m
        for x in (left, right):
            self.box(x - 1, middle - 5, x + 1, middle + 5, self.theme.text)
        self.box(left, middle - 1, right, middle + 1, self.theme.text)
        self.text(right + 8, middle, f"{metres:g} m", 13)

    def path(self) -> None:
        """Draw the camera path, with a dot at its start."""
        points = [self.position(0, x, y) for x, y in self.plan.path_m.tolist()]
        colour = self.theme.curves[GREEN]
        if len(points) > 1:
            larger = [(x * DRAW_SCALE, y * DRAW_SCALE) for x, y in points]
            self.pen.line(larger, colour, 2 * DRAW_SCALE, joint="curve")
        self.circle(*points[0], 4, colour, True)

    def region_circles(self) -> None:
        """Draw a circle at the widest place of each region in every panel, with its number in the first panel."""
        for panel in range(3):
            for number, region in enumerate(self.plan.regions, 1):
                x, y = self.position(panel, *region.center_m)
                colour = self.theme.curves[REASON_COLOURS[region.why]]
                self.circle(x, y, max(DOT, region.radius_m / self.plan.cell_m * self.cell_px), colour, False)
                if panel == 0:
                    self.numbered_dot(x, y, number, colour)

    def numbered_dot(self, x: float, y: float, number: int, colour: Colour) -> None:
        """Draw a number on a dot."""
        self.circle(x, y, DOT, colour, True)
        self.text(x, y, str(number), 13, "mm", self.theme.background)

    def legend(self) -> None:
        """Draw the legend of the first panel."""
        for line, entries in enumerate(self.legend_rows):
            x, y = float(self.gap), self.below + (line + 0.5) * LINE
            for words, colour in entries:
                self.box(x, y - 6, x + 12, y + 6, colour)
                x += 36 + self.text(x + 18, y, words, 13)

    def region_list(self) -> None:
        """List the regions to scan again, with reason, size and position, and the rule for unsure ones."""
        y = self.below + (len(self.legend_rows) + 1.0) * LINE
        self.text(self.gap, y, "Where to scan again", 17)
        for number, words in enumerate(self.listed, 1):
            y += LINE
            if number <= len(self.plan.regions):
                why = self.plan.regions[number - 1].why
                self.numbered_dot(self.gap + DOT, y, number, self.theme.curves[REASON_COLOURS[why]])
            self.text(self.gap + (INDENT if self.plan.regions else 0), y, words, 14)
