"""Draw the views of the report, one figure per panel."""

import base64
import io
from dataclasses import dataclass

from PIL import Image

from sigmasplat.plugins.evaluation.metrics.views import ScoredView
from sigmasplat.plugins.outputs.drawing.view_panels import (
    PANEL_WIDTH,
    ViewPanel,
    view_panels,
)

QUALITY, EFFORT = 86, 2
"""Quality of WebP, and the effort to compress (0 to 6; a larger one takes longer and hardly saves space)."""
PAGE_WIDTH = 1152
"""Width of the page's text column at twice the resolution of a panel, in pixels."""
HEADINGS = {"test": "novel views"}
"""Headings of kinds of views; without an entry "<kind> views"."""


@dataclass(frozen=True)
class PanelFigure:
    """One panel of a view on the page: title, address of its picture, and a caption or a colour bar.

    bar: CSS colours from low to high; ends: the labels of both ends of the bar.
    """

    title: str
    address: str
    caption: str = ""
    bar: tuple[str, ...] = ()
    ends: tuple[str, str] = ("", "")


class ViewStrips:
    """Collect the panels of a few views of each kind for the page."""

    def __init__(self, per_kind: int) -> None:
        self.per_kind = per_kind
        self.figures: dict[str, list[list[PanelFigure]]] = {}

    def add(self, view: ScoredView, place: str = "") -> None:
        """Keep the panels of a view; `place` is added to the heading if it was not rendered from the final map."""
        heading = HEADINGS.get(view.kind, f"{view.kind} views") + place
        self.figures.setdefault(heading, []).append([panel_figure(panel) for panel in view_panels(view)])


def panel_figure(panel: ViewPanel) -> PanelFigure:
    """Return a panel for the page, with its picture as a data: URI.

    Pictures larger than a panel of a strip keep their size, up to `PAGE_WIDTH`.
    """
    width = min(max(PANEL_WIDTH, panel.pixels.shape[1]), PAGE_WIDTH)
    height = round(width * panel.pixels.shape[0] / panel.pixels.shape[1])
    colours = () if panel.bar is None else tuple(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in panel.bar)
    return PanelFigure(panel.title, data_uri(panel.picture(width, height)), panel.caption, colours, panel.ends)


def data_uri(picture: Image.Image) -> str:
    """Return a picture as a data: URI, WebP."""
    buffer = io.BytesIO()
    picture.convert("RGB").save(buffer, "WEBP", quality=QUALITY, method=EFFORT)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
