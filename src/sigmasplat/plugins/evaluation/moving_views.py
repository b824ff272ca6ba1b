"""Show what a run took for moving: keyframes with the pixels that are masked in the map."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening

from sigmasplat.config import InputConfig
from sigmasplat.data.selection import evenly_spread
from sigmasplat.data.submap import SubmapStore
from sigmasplat.errors import SourceError
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.report.view_strips import ViewStrips
from sigmasplat.plugins.evaluation.view_selection import working_frame
from sigmasplat.plugins.outputs.drawing.view_panels import ViewPanel

HEADING, PANELS = "taken for moving", 4
TINT = np.array([1.0, 0.2, 0.6], np.float32)
LEAST_SHARE = 0.01
"""Frames with a smaller share are not shown."""


def show_moving(
    strips: ViewStrips, source: Source, settings: InputConfig, store: SubmapStore, log: list[dict[str, Any]]
) -> None:
    """Add a strip of keyframes in which something moved, tinted where the map does not use them; nothing without."""
    shares = [(record.get("tracking") or {}).get("moving", 0.0) for record in log]
    if not any(share >= LEAST_SHARE for share in shares):
        return
    places = [(row, s, k) for s in range(len(store)) for k, row in enumerate(store.load(s).frames) if row >= 0]
    moving = [place for place in places if place[0] < len(log) and shares[place[0]] >= LEAST_SHARE]
    panels = []
    for row, s, k in evenly_spread(moving, PANELS):
        try:
            frame = working_frame(source, settings, log[row]["index"])
        except SourceError:
            continue
        depth_m = store.picture(s, k).depth_m
        if depth_m.shape == frame.depth_m.shape:
            masked = binary_opening((depth_m == 0) & (frame.depth_m > 0))
            caption = f"frame {frame.index} · {100 * shares[row]:.0f} % of the image"
            panels.append(ViewPanel(f"frame {frame.index}", tinted(frame.color, masked), caption))
    if panels:
        strips.draw("view-moving.png", HEADING, panels)


def tinted(color: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return colour [H, W, 3] in [0, 1] as bytes, with a tint at some pixels [H, W]."""
    shown = np.where(mask[..., None], 0.5 * color + 0.5 * TINT, color)
    return np.asarray(np.rint(255.0 * np.clip(shown, 0.0, 1.0)), np.uint8)
