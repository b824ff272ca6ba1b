"""Draw a contact sheet: small pictures of a sequence in rows and columns."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sigmasplat.plugins.outputs.drawing import colormap
from sigmasplat.plugins.outputs.drawing.view_panels import BACKGROUND, FAINT, TEXT

WIDTH, GAP, HEAD, LINE = 260, 8, 28, 26


@dataclass(frozen=True, eq=False)
class SheetColumn:
    """One column: its title, and a picture uint8 [H, W, 3] for each row."""

    title: str
    pictures: tuple[colormap.Rgb, ...]


def draw_contact_sheet(columns: Sequence[SheetColumn], rows: Sequence[str]) -> Image.Image:
    """Draw the columns side by side, with the name of each row above it. All pictures get the aspect of the first."""
    first = columns[0].pictures[0]
    height = round(WIDTH * first.shape[0] / first.shape[1])
    size = (len(columns) * (WIDTH + GAP) + GAP, HEAD + len(rows) * (height + LINE) + GAP)
    made = Image.new("RGB", size, BACKGROUND)
    draw, font = ImageDraw.Draw(made), ImageFont.load_default(15)
    for k, column in enumerate(columns):
        left = GAP + k * (WIDTH + GAP)
        draw.text((left + 2, HEAD // 2), column.title, FAINT, font, anchor="lm")
        for r, picture in enumerate(column.pictures):
            small = Image.fromarray(np.ascontiguousarray(picture)).resize((WIDTH, height), Image.Resampling.LANCZOS)
            made.paste(small, (left, HEAD + r * (height + LINE) + LINE))
    for r, name in enumerate(rows):
        draw.text((GAP + 2, HEAD + r * (height + LINE) + LINE // 2), name, TEXT, font, anchor="lm")
    return made
