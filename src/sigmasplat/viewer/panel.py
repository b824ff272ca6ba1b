"""Lay out the controls beside the scene, and say what they ask for."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import viser

from sigmasplat.drawing.colormap import NO_READING, Rgb
from sigmasplat.viewer.pictures import LEGEND_SIZE, Layer
from sigmasplat.viewer.splats import Colouring

Kind = Literal["splats", "colour", "depth", "V", "U", "opacity"]
KINDS: tuple[Kind, ...] = ("splats", "colour", "depth", "V", "U", "opacity")
SAYS: dict[Kind, str] = {
    "splats": "splats, drawn by the browser",
    "colour": "colour, rendered by SigmaSplat",
    "depth": "depth",
    "V": "V: variance of colour, as root",
    "U": "U: variance of depth, as root",
    "opacity": "opacity",
}
WHOLE, PARTS = "final map", "submaps"


@dataclass(frozen=True)
class Wanted:
    """What the controls ask for."""

    kind: Kind
    colouring: Colouring
    whole: bool
    hidden_share: float
    least_opacity: float
    row: int
    path: bool
    keyframes: bool
    thumbnails: bool
    true_path: bool
    follow: bool

    @property
    def layer(self) -> Layer | None:
        """Return the layer to render on this side; None where the browser draws splats."""
        return None if self.kind == "splats" else self.kind


class Panel:
    """The controls. `changed` is called after each change; `look_from` with the browser whose user asked to go to the
    timeline's frame."""

    def __init__(
        self, server: viser.ViserServer, changed: Callable[[], None], look_from: Callable[[viser.ClientHandle], None]
    ) -> None:
        gui = server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(214, 90, 30))
        self.facts = gui.add_markdown("waiting for the first frame")
        self.caption = gui.add_markdown("Click on a keyframe to go there and see what it saw.")
        self.picture = gui.add_image(np.full((3, 4, 3), NO_READING, np.uint8), visible=False, jpeg_quality=90)
        self._map(gui)
        self._path(gui)
        self.look.on_click(lambda event: look_from(event.client) if event.client else None)
        for control in self._controls():
            control.on_update(lambda _: changed())

    def _map(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Map"):
            self.kind = gui.add_dropdown("show", tuple(SAYS[kind] for kind in KINDS))
            self.colouring = gui.add_dropdown(
                "splats in", ("colour", "σ"), hint="their own colours, or σ: how doubtful their colour is, dark = sure"
            )
            self.part = gui.add_dropdown(
                "of", (WHOLE, PARTS), hint="the map as it was made in the end, or the submaps that it was made of"
            )
            self.legend = gui.add_image(np.zeros((*LEGEND_SIZE[::-1], 3), np.uint8), visible=False, format="png")
            self.hidden = gui.add_slider(
                "hide doubtful", 0, 99, 1, 0, hint="hide this share of the splats, in percent: those of the largest σ"
            )
            self.faint = gui.add_slider("hide fainter than", 0.0, 0.99, 0.01, 0.0, hint="opacity")
            self.cut = gui.add_markdown("")

    def _path(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Path"):  # Any: mypy takes `value` for read-only
            self.row: Any = gui.add_slider("frame", 0, 1, 1, 1, hint="the path up to here, the submaps begun by then")
            self.frame = gui.add_markdown("")
            self.look = gui.add_button("look from here")
            self.follow = gui.add_checkbox("follow the camera", False, visible=False)
            self.path = gui.add_checkbox("path", True)
            self.keyframes = gui.add_checkbox("keyframes", True)
            self.thumbnails: Any = gui.add_checkbox("what they saw", True)
            self.true_path = gui.add_checkbox("truth", True, visible=False)

    def _controls(self) -> tuple[Any, ...]:
        return (
            self.kind, self.colouring, self.part, self.hidden, self.faint, self.row, self.follow, self.path,
            self.keyframes, self.thumbnails, self.true_path,
        )  # fmt: skip

    def wanted(self) -> Wanted:
        """Return what is asked for now."""
        return Wanted(
            next(kind for kind in KINDS if SAYS[kind] == self.kind.value),
            "σ" if self.colouring.value == "σ" else "colour",
            self.part.value == WHOLE,
            self.hidden.value / 100.0,
            float(self.faint.value),
            int(self.row.value),
            self.path.value,
            self.keyframes.value,
            self.thumbnails.value,
            self.true_path.value,
            self.follow.value,
        )

    def offer(self, frames: int, live: bool, truth_known: bool, whole: bool, parts: bool) -> None:
        """Fit the controls to what there is; the timeline stays at its end while frames are added."""
        last = max(frames - 1, 1)
        at_end = self.row.value >= self.row.max
        if last != self.row.max:
            if last < self.row.value:
                self.row.value = last
            self.row.max = last
            if at_end:
                self.row.value = last
        self.follow.visible, self.true_path.visible, self.part.visible = live, truth_known, whole and parts

    def say(self, facts: str, cut: str, frame: str) -> None:
        """Show texts: of the whole run, of what is cut off, of the timeline's frame."""
        self.facts.content, self.cut.content, self.frame.content = facts, cut, frame

    def show_legend(self, pixels: Rgb | None) -> None:
        """Show what colours mean, None where they are the scene's own."""
        if pixels is not None:
            self.legend.image = pixels
        self.legend.visible = pixels is not None

    def show_picture(self, caption: str, pixels: Rgb | None) -> None:
        """Show what a keyframe saw."""
        self.caption.content = caption
        if pixels is not None:
            self.picture.image = pixels
        self.picture.visible = pixels is not None
