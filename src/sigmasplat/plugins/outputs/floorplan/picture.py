"""Draw a floor plan: what is there, and the predicted errors of colour and depth."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from sigmasplat.api import Progress, RunError, no_progress, replacing, write_json
from sigmasplat.plugins.outputs.drawing import colormap
from sigmasplat.plugins.outputs.drawing.plot import DARK, GREEN, nice_ticks
from sigmasplat.plugins.outputs.drawing.view_panels import (
    BACKGROUND,
    GAP,
    PANEL_WIDTH,
    TEXT,
    ViewPanel,
    draw_view_strip,
)
from sigmasplat.plugins.outputs.floorplan.floor_plan import (
    CELL_M,
    FLOOR_UNOBSERVED,
    FREE,
    MEANINGS,
    UNOBSERVED,
    FloorPlan,
    run_floor_plan,
)
from sigmasplat.plugins.outputs.floorplan.ground import WRONG_BY, Edge
from sigmasplat.plugins.outputs.run_reader import RunReader

SCALE = 2
"""Panels are drawn this many times larger and then reduced, because PIL does not smooth lines."""
WIDEST, TALLEST = PANEL_WIDTH * SCALE, 3 * PANEL_WIDTH
LINE = 22
KIND_COLOURS = np.array([(45, 49, 55), (39, 56, 76), (24, 27, 32), (92, 98, 105), (176, 184, 194)], np.uint8)
"""Of the cells in the order of their kinds, as in `FloorPlan`."""
PATH_COLOUR = DARK[GREEN]


def draw_floor_plan(plan: FloorPlan) -> Image.Image:
    """Draw a plan: its panels side by side, and below them the legend."""
    strip, measured = draw_view_strip(plan_panels(plan)), (FLOOR_UNOBSERVED, FREE)
    rows = [
        (f"{meaning}, {plan.area_m2(kind):.1f} sq m" if kind in measured else meaning, tuple(colour))
        for kind, (meaning, colour) in enumerate(zip(MEANINGS, KIND_COLOURS.tolist(), strict=True))
    ]
    rows.append(("camera path", PATH_COLOUR))
    font = ImageFont.load_default(14)
    widest = max(font.getlength(words) for words, _ in rows)
    size = max(strip.width, round(widest) + 6 * GAP), strip.height + LINE * (len(rows) + 1)
    image = Image.new("RGB", size, BACKGROUND)
    image.paste(strip)
    draw, y = ImageDraw.Draw(image), strip.height + LINE // 2
    for words, colour in rows:
        draw.rectangle((GAP, y - 6, GAP + 12, y + 6), colour, outline=TEXT)
        draw.text((GAP + 22, y), words, TEXT, font, anchor="lm")
        y += LINE
    return image


def export_plan(
    reader: RunReader, target: Path, *, cell_m: float = CELL_M, up: Edge = "auto", progress: Progress = no_progress
) -> FloorPlan:
    """Write the image (.png) and the data of the plan beside it (.json); return the plan. up: at this edge of images.

    Calls `progress(done, total)` for each rendered view. Raises RunError on another ending, without a map or path, or
    if a file cannot be written; ConfigError unless 1 mm ≤ cell_m ≤ 1 m.
    """
    if target.suffix.lower() != ".png":
        raise RunError(f"cannot write a floor plan as {target.name}; give a name that ends in .png")
    plan = run_floor_plan(reader.run, reader.valid_path(), reader.camera, cell_m=cell_m, up=up, progress=progress)
    picture = draw_floor_plan(plan)
    with replacing(target) as temporary:
        picture.save(temporary, "PNG")
    write_json(target.with_suffix(".json"), plan.record())
    return plan


def plan_panels(plan: FloorPlan) -> list[ViewPanel]:
    """Return the panels of a plan, y upwards: what is there; with predicted errors also those of colour and depth."""
    panels = [ViewPanel("What is there", _drawn(plan, KIND_COLOURS[plan.kind], with_path=True))]
    for title, values, unit, scale in (
        (f"Colour: pixels wrong by > {WRONG_BY:g}", plan.wrong_share, " %", 100.0),
        ("Depth: standard deviation", plan.depth_sigma_m, " cm", 100.0),
    ):
        known = np.isfinite(values)
        if known.any():
            high = max(colormap.value_range(values, known)[1], 1e-6)
            cells = colormap.apply(np.where(known, values, 0.0), 0.0, high, colormap.INFERNO)
            cells[~known] = np.where(plan.kind == UNOBSERVED, 1, 0)[~known, None] * KIND_COLOURS[UNOBSERVED]
            ends = ("0", f"{scale * high:.2g}{unit}")
            panels.append(ViewPanel(title, _drawn(plan, cells), bar=colormap.INFERNO, ends=ends))
    return panels


def _drawn(plan: FloorPlan, cells: NDArray[np.uint8], with_path: bool = False) -> colormap.Rgb:
    """Return the pixels of a panel: cells with y upwards, and in the first panel the path and a scale bar."""
    rows, columns = plan.kind.shape
    cell_px = min(WIDEST / columns, TALLEST / rows)
    size = max(1, round(columns * cell_px)), max(1, round(rows * cell_px))
    image = Image.fromarray(np.ascontiguousarray(cells[::-1])).resize(size, Image.Resampling.NEAREST)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(13 * SCALE)

    def place(x_m: float, y_m: float) -> tuple[float, float]:
        x, y = (np.array([x_m, y_m]) - plan.origin_m) / plan.cell_m * cell_px
        return float(x), size[1] - float(y)

    if with_path:
        points = [place(x, y) for x, y in plan.path_m.tolist()]
        draw.line(points, PATH_COLOUR, 2 * SCALE, joint="curve")
        draw.circle(points[0], 4 * SCALE, PATH_COLOUR)
        metres = float(nice_ticks(0.0, 0.4 * columns * plan.cell_m, 2)[-1])
        y, right = size[1] - 8 * SCALE, 8 * SCALE + metres / plan.cell_m * cell_px
        draw.line((8 * SCALE, y, right, y), TEXT, 2 * SCALE)
        draw.text((right + 4 * SCALE, y), f"{metres:g} m", TEXT, font, anchor="lm")
    return np.asarray(image)
