"""Draw a floor plan as one picture: what is there, how sure colour and depth are, and where to scan again."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from sigmasplat.drawing import colormap
from sigmasplat.drawing.plot import ACCENT, BLUE, DRAW_SCALE, GREEN, LIGHT, PURPLE, Colour, Theme, nice_ticks
from sigmasplat.floorplan.floor_plan import BARE, FREE, THING, UNSEEN, WALL, FloorPlan

PANEL_PX = 440
"""The longer side of a panel."""
GAP, HEAD, FOOT, LINE = 24, 40, 44, 24
LEAST_WIDTH, DOT = 760, 9
REASONS = {"unseen": BLUE, "thin": PURPLE, "unsure": ACCENT}
UNSEEN_SHADE, THING_SHADE, BARE_SHADE = 0.14, 0.45, 0.2
"""Between background and text; the last between background and the colour of what was not seen."""

Corner = tuple[int, int]
Floats = NDArray[np.float32]


def draw_floor_plan(plan: FloorPlan, theme: Theme = LIGHT) -> Image.Image:
    """Draw a plan, y upwards: three panels, one below the other where it is wide, and the regions in words below."""
    sheet = _Sheet(plan, theme)
    color_high, depth_high = _high(plan.color_sigma), _high(plan.depth_sigma_m)
    sheet.panel(0, kinds_picture(plan, theme), "What is there")
    sheet.panel(1, _measured(plan, plan.color_sigma, color_high, theme), "Colour: deviation of the splats")
    sheet.panel(2, _measured(plan, plan.depth_sigma_m, depth_high, theme), "Depth: how far splats disagree")
    sheet.scale()
    sheet.bar(1, f"{color_high:.2g}")
    sheet.bar(2, f"{100.0 * depth_high:.2g} cm")
    sheet.path()
    sheet.numbers()
    sheet.legend()
    sheet.words()
    return sheet.finished()


def kinds_picture(plan: FloorPlan, theme: Theme) -> colormap.Rgb:
    """Colour the cells by what they are, uint8 [rows, columns, 3], row 0 still the lowest y."""
    shades = np.array([_shades(theme)[kind] for kind in range(WALL + 1)], np.uint8)
    return np.asarray(shades[plan.kind])


def _shades(theme: Theme) -> dict[int, Colour]:
    """Return the colour of each kind of cell."""
    return {
        UNSEEN: _mix(theme, UNSEEN_SHADE, theme.text),
        BARE: _mix(theme, BARE_SHADE, theme.curves[BLUE]),
        FREE: theme.background,
        THING: _mix(theme, THING_SHADE, theme.text),
        WALL: theme.text,
    }


def _mix(theme: Theme, share: float, towards: Colour) -> Colour:
    """Return a shade between the background and another colour."""
    r, g, b = (round(a + share * (c - a)) for a, c in zip(theme.background, towards, strict=True))
    return r, g, b


def _measured(plan: FloorPlan, values: Floats, high: float, theme: Theme) -> colormap.Rgb:
    """Colour what was measured, from 0 to `high`; the rest is background, or shaded where it was never seen."""
    there = np.isfinite(values)
    out = colormap.picture(np.where(there, values, 0.0), there, 0.0, high, colormap.INFERNO)
    out[~there] = theme.background
    out[~there & (plan.kind == UNSEEN)] = _shades(theme)[UNSEEN]
    return out


def _high(values: Floats) -> float:
    """Return the 99th percentile, the end of a scale."""
    return max(colormap.span(values, np.isfinite(values))[1], 1e-6)


def _font(size: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(size * DRAW_SCALE)


class _Sheet:
    """The picture while it is drawn, `DRAW_SCALE` times as large; places are in pixels of the finished one."""

    def __init__(self, plan: FloorPlan, theme: Theme) -> None:
        self.plan, self.theme = plan, theme
        rows, columns = plan.kind.shape
        self.cell_px = max(1, round(PANEL_PX / max(rows, columns)))
        self.width, self.height = columns * self.cell_px, rows * self.cell_px
        self.stacked = columns > 1.6 * rows
        across, down = (1, 3) if self.stacked else (3, 1)
        self.below = down * (HEAD + self.height + FOOT) + GAP // 2
        lines = 4 + max(1, len(plan.regions))
        size = (max(across * (self.width + GAP) + GAP, LEAST_WIDTH), self.below + lines * LINE)
        self.image = Image.new("RGB", (size[0] * DRAW_SCALE, size[1] * DRAW_SCALE), theme.background)
        self.pen = ImageDraw.Draw(self.image)

    def finished(self) -> Image.Image:
        """Return the picture."""
        size = (self.image.width // DRAW_SCALE, self.image.height // DRAW_SCALE)
        return self.image.resize(size, Image.Resampling.LANCZOS)

    def corner(self, number: int) -> Corner:
        """Return the upper left corner of a panel's cells."""
        right, down = (0, number) if self.stacked else (number, 0)
        return GAP + right * (self.width + GAP), HEAD + down * (HEAD + self.height + FOOT)

    def place(self, number: int, x_m: float, y_m: float) -> tuple[float, float]:
        """Return where a point of the floor is in a panel."""
        (left, top), (x, y) = self.corner(number), (np.array([x_m, y_m]) - self.plan.origin_m) / self.plan.cell_m
        return left + float(x) * self.cell_px, top + self.height - float(y) * self.cell_px

    def text(self, x: float, y: float, words: str, size: int, anchor: str = "lm", fill: Colour | None = None) -> float:
        """Write, and return how long the words are."""
        font = _font(size)
        self.pen.text((x * DRAW_SCALE, y * DRAW_SCALE), words, fill or self.theme.text, font, anchor=anchor)
        return self.pen.textlength(words, font) / DRAW_SCALE

    def box(self, left: float, top: float, right: float, bottom: float, fill: Colour | None) -> None:
        """Draw a rectangle with a thin edge."""
        corners = [value * DRAW_SCALE for value in (left, top, right, bottom)]
        self.pen.rectangle(corners, fill=fill, outline=self.theme.grid, width=DRAW_SCALE)

    def circle(self, x: float, y: float, radius: float, colour: Colour, filled: bool) -> None:
        """Draw a circle or a dot."""
        corners = [value * DRAW_SCALE for value in (x - radius, y - radius, x + radius, y + radius)]
        self.pen.ellipse(corners, fill=colour if filled else None, outline=colour, width=2 * DRAW_SCALE)

    def panel(self, number: int, cells: colormap.Rgb, title: str) -> None:
        """Put a panel's cells in their place, y upwards, and its title above."""
        (left, top), size = self.corner(number), (self.width * DRAW_SCALE, self.height * DRAW_SCALE)
        picture = Image.fromarray(np.ascontiguousarray(cells[::-1])).resize(size, Image.Resampling.NEAREST)
        self.image.paste(picture, (left * DRAW_SCALE, top * DRAW_SCALE))
        self.box(left, top, left + self.width, top + self.height, None)
        self.text(left, top - HEAD / 2, title, 17)

    def bar(self, number: int, end: str) -> None:
        """Draw a colour bar from 0 to its end under a panel."""
        left, top = self.corner(number)
        width, middle = min(220, self.width // 2), top + self.height + FOOT // 2
        ramp = np.tile(np.linspace(0.0, 1.0, width * DRAW_SCALE), (10 * DRAW_SCALE, 1))
        picture = Image.fromarray(colormap.colour(ramp, 0.0, 1.0, colormap.INFERNO))
        self.image.paste(picture, ((left + 16) * DRAW_SCALE, (middle - 5) * DRAW_SCALE))
        self.text(left, middle, "0", 13)
        self.text(left + 22 + width, middle, end, 13)

    def scale(self) -> None:
        """Draw a bar of a round number of metres under the first panel."""
        left, top = self.corner(0)
        middle, px_per_m = top + self.height + FOOT / 2, self.cell_px / self.plan.cell_m
        metres = float(nice_ticks(0.0, 0.4 * self.width / px_per_m, 2)[-1])
        right = left + metres * px_per_m
        for x in (left, right):
            self.box(x - 1, middle - 5, x + 1, middle + 5, self.theme.text)
        self.box(left, middle - 1, right, middle + 1, self.theme.text)
        self.text(right + 8, middle, f"{metres:g} m", 13)

    def path(self) -> None:
        """Draw where the camera went, a dot where it began."""
        points = [self.place(0, x, y) for x, y in self.plan.path_m.tolist()]
        colour = self.theme.curves[GREEN]
        if len(points) > 1:
            larger = [(x * DRAW_SCALE, y * DRAW_SCALE) for x, y in points]
            self.pen.line(larger, colour, 2 * DRAW_SCALE, joint="curve")
        self.circle(*points[0], 4, colour, True)

    def numbers(self) -> None:
        """Circle the regions' widest places in every panel, number them in the first."""
        for panel in range(3):
            for number, region in enumerate(self.plan.regions, 1):
                x, y = self.place(panel, *region.center_m)
                colour = self.theme.curves[REASONS[region.why]]
                self.circle(x, y, max(DOT, region.radius_m / self.plan.cell_m * self.cell_px), colour, False)
                if panel == 0:
                    self.numbered(x, y, number, colour)

    def numbered(self, x: float, y: float, number: int, colour: Colour) -> None:
        """Draw a number on a dot."""
        self.circle(x, y, DOT, colour, True)
        self.text(x, y, str(number), 13, "mm", (255, 255, 255))

    def legend(self) -> None:
        """Say what the shades of the first panel mean, on a line of its own."""
        x, y, shades = float(GAP), self.below + LINE / 2, _shades(self.theme)
        area: Callable[[int], str] = lambda kind: f"{self.plan.area_m2(kind):.1f} sq m"  # noqa: E731
        entries = [
            ("never seen", shades[UNSEEN]), (f"floor never seen, {area(BARE)}", shades[BARE]),
            (f"free floor, {area(FREE)}", shades[FREE]), ("things", shades[THING]), ("walls", shades[WALL]),
            ("the camera's path", self.theme.curves[GREEN]),
        ]  # fmt: skip
        for words, colour in entries:
            self.box(x, y - 6, x + 12, y + 6, colour)
            x += 36 + self.text(x + 18, y, words, 13)

    def words(self) -> None:
        """Say in words where to scan again and why."""
        y = self.below + 2.0 * LINE
        self.text(GAP, y, "Where to scan again", 17)
        if not self.plan.regions:
            self.text(GAP, y + LINE, "Nowhere: everything was in view, and the map is sure of it.", 14)
        for number, region in enumerate(self.plan.regions, 1):
            y += LINE
            self.numbered(GAP + DOT, y, number, self.theme.curves[REASONS[region.why]])
            x_m, y_m = region.center_m
            aside, along = "right" if x_m > 0 else "left", "ahead of" if y_m > 0 else "behind"
            where = f"{abs(x_m):.1f} m {aside}, {abs(y_m):.1f} m {along}"
            self.text(GAP + 28, y, f"{region.why}: {region.found} · {region.area_m2:.2f} sq m · {where} the start", 14)
