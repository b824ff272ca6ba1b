"""Lay out the controls beside the scene and read their state."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
import viser

from sigmasplat.plugins.outputs.drawing.colormap import NO_READING, Rgb
from sigmasplat.plugins.viewer.layers import LEGEND_SIZE, MODES, PREDICTED_MODES, Colouring


@dataclass(frozen=True)
class ControlState:
    """The values of the controls at one time."""

    mode: str
    colouring: Colouring
    hidden_share: float
    row: int
    path: bool
    keyframes: bool
    true_path: bool
    follow: bool

    @property
    def layer(self) -> str | None:
        """Return the layer that SigmaSplat renders, or None if the browser draws the scene."""
        return None if self.mode == "splats" else self.mode


class ControlPanel:
    """The controls. Calls `changed()` after each change, and `look_from(client)` after a click on "look from here"."""

    def __init__(
        self, server: viser.ViserServer, changed: Callable[[], None], look_from: Callable[[viser.ClientHandle], None]
    ) -> None:
        gui = server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(214, 90, 30))
        self.facts = gui.add_markdown("waiting for the first frame")
        self.caption = gui.add_markdown("")
        self.image = gui.add_image(np.full((3, 4, 3), NO_READING, np.uint8), visible=False, jpeg_quality=90)
        self._add_map_controls(gui)
        self._add_path_controls(gui)
        self.look.on_click(lambda event: look_from(event.client) if event.client else None)
        for control in (
            self.mode, self.colouring, self.hidden, self.row, self.follow, self.path, self.keyframes, self.true_path,
        ):  # fmt: skip
            control.on_update(lambda _: changed())

    def _add_map_controls(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Map"):
            self.mode: Any = gui.add_dropdown("show", _mode_options(predicted=False))
            self.colouring: Any = gui.add_dropdown(
                "splat colour",
                get_args(Colouring),
                hint="the splats' own colours, or how unsure they are: bright = uncertain",
            )
            self.legend = gui.add_image(np.zeros((*LEGEND_SIZE[::-1], 3), np.uint8), visible=False, format="png")
            self.hidden = gui.add_slider(
                "hide uncertain", 0, 99, 1, 0, hint="hide this percentage of the splats: the most uncertain ones"
            )
            self.hidden_text = gui.add_markdown("")

    def _add_path_controls(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Path", expand_by_default=False):  # Any: mypy takes `value` for read-only
            self.row: Any = gui.add_slider("frame", 0, 1, 1, 1, hint="show the path and the submaps up to this frame")
            self.frame = gui.add_markdown("")
            self.look = gui.add_button("look from here")
            self.follow = gui.add_checkbox("follow the camera", False, visible=False)
            self.path = gui.add_checkbox("path", True)
            self.keyframes = gui.add_checkbox(
                "keyframes", False, hint="click a keyframe to move there and to see its image"
            )
            self.true_path = gui.add_checkbox("ground truth", True, visible=False)

    def state(self) -> ControlState:
        """Return the current values of the controls."""
        return ControlState(
            next(mode for mode, label in MODES.items() if label == self.mode.value),
            self.colouring.value,
            self.hidden.value / 100.0,
            int(self.row.value),
            self.path.value,
            self.keyframes.value,
            self.true_path.value,
            self.follow.value,
        )

    def adapt(self, frames: int, live: bool, truth_known: bool) -> None:
        """Adapt the controls to the snapshot; a timeline at its end stays there while frames are added."""
        last = max(frames - 1, 1)
        at_end = self.row.value >= self.row.max
        if last != self.row.max:
            if last < self.row.value:
                self.row.value = last
            self.row.max = last
            if at_end:
                self.row.value = last
        self.follow.visible, self.true_path.visible = live, truth_known

    def offer(self, known: bool) -> None:
        """Offer to show predicted errors if the shown map has them (`known`)."""
        options = _mode_options(known)
        if self.mode.options != options:
            self.mode.options = options

    def show_legend(self, pixels: Rgb | None) -> None:
        """Show the colour legend, or hide it if None."""
        if pixels is not None:
            self.legend.image = pixels
        self.legend.visible = pixels is not None

    def show_image(self, caption: str, pixels: Rgb | None) -> None:
        """Show the image of a keyframe, or the caption alone if None."""
        self.caption.content = caption
        if pixels is not None:
            self.image.image = pixels
        self.image.visible = pixels is not None


def escaped(text: str) -> str:
    """Return text from a file or a path so that the browser shows it and runs nothing: viser's Markdown has tags, and
    expressions in braces."""
    return "".join(c if c.isalnum() or c in " .,-" or not c.isascii() else f"&#{ord(c)};" for c in text)


def _mode_options(predicted: bool) -> tuple[str, ...]:
    return tuple(label for mode, label in MODES.items() if predicted or mode not in PREDICTED_MODES)
