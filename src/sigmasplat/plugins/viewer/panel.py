"""Lay out the controls beside the scene and read their state."""

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from sigmasplat.plugins.outputs.drawing.colormap import NO_READING, Rgb
from sigmasplat.plugins.viewer.layers import LEGEND_SIZE, MODES, PREDICTED_MODES


class ControlPanel:
    """The controls. Calls `changed()` after each change, `look_from(client)` after a click on "go there", and
    `measure()` after one on "measure a distance"."""

    def __init__(
        self, server: viser.ViserServer, changed: Callable[[], None],
        look_from: Callable[[viser.ClientHandle], None], measure: Callable[[], None],
    ) -> None:  # fmt: skip
        gui = server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(214, 90, 30))
        self.facts = gui.add_markdown("waiting for the first frame")
        self.caption = gui.add_markdown("")
        self.image = gui.add_image(np.full((3, 4, 3), NO_READING, np.uint8), visible=False, jpeg_quality=90)
        self._add_map_controls(gui)
        self._add_path_controls(gui)
        self.look.on_click(lambda event: look_from(event.client) if event.client else None)
        self.measure.on_click(lambda _: measure())
        for control in (
            self.mode, self.colouring, self.unsure, self.row, self.follow, self.path, self.keyframes, self.true_path,
        ):  # fmt: skip
            control.on_update(lambda _: changed())

    def _add_map_controls(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Scene"):  # Any: mypy takes `value` for read-only
            self.mode: Any = gui.add_dropdown("show", _mode_options(predicted=False))
            self.colouring: Any = gui.add_dropdown(
                "colours", ("their own", "how unsure"), hint="dark = the run is sure of this part, bright = unsure"
            )
            self.legend = gui.add_image(np.zeros((*LEGEND_SIZE[::-1], 3), np.uint8), visible=False, format="png")
            self.unsure: Any = gui.add_checkbox(
                "show what is uncertain", False, visible=False, hint="also show parts that may be in a wrong place"
            )
            self.floating: Any = gui.add_checkbox(
                "float gently", False, visible=False, hint="sway around the scene; stops when you move the view"
            )
            self.measure = gui.add_button("measure a distance", hint="then click two points of the scene")
            self.length = gui.add_markdown("")

    def _add_path_controls(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Camera", expand_by_default=False):
            self.row: Any = gui.add_slider("image", 0, 1, 1, 1, hint="an image of the recording, by its number")
            self.frame = gui.add_markdown("")
            self.look = gui.add_button("go there", hint="look from where this image was taken")
            self.follow: Any = gui.add_checkbox(
                "follow the camera", False, visible=False, hint="stay behind the camera while it records"
            )
            self.path: Any = gui.add_checkbox("its path", False, hint="red: where it did not know its position")
            self.keyframes = gui.add_checkbox(
                "images kept", False, hint="the map is made from these; click one to go there and see it"
            )
            self.true_path: Any = gui.add_checkbox(
                "its true path", False, visible=False, hint="blue: measured by others"
            )

    @property
    def layer(self) -> str | None:
        """Return the layer that SigmaSplat renders, or None if the browser draws the scene."""
        mode = next(mode for mode, label in MODES.items() if label == self.mode.value)
        return None if mode == "splats" else mode

    def adapt(self, frames: int, live: bool, truth_known: bool) -> None:
        """Adapt the controls to the snapshot; a timeline at its end stays there while frames are added."""
        if not (self.follow.visible or self.floating.visible):  # the first one
            self.floating.value, self.path.value = not live, live
        last = max(frames - 1, 1)
        at_end = self.row.value >= self.row.max
        if last != self.row.max:
            if last < self.row.value:
                self.row.value = last
            self.row.max = last
            if at_end:
                self.row.value = last
        self.follow.visible, self.floating.visible, self.true_path.visible = live, not live, truth_known

    def offer(self, known: bool, unsure: bool) -> None:
        """Offer to show predicted errors if the shown map has them (`known`), and what is uncertain if a part is."""
        self.unsure.visible = unsure
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
