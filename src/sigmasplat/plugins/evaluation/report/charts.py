"""Prepare the charts of a run: path from above, height, states of the frames."""

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import APART, LOST, RELOCALISED, TRACKED, Matrix, RunFrames
from sigmasplat.plugins.outputs.drawing.plot import ACCENT, BLUE, FAINT, GREEN, PURPLE, Chart, Curve

STATE_COLOURS = {TRACKED: GREEN, APART: PURPLE, LOST: ACCENT, RELOCALISED: BLUE}
"""In the order of drawing."""
STRIP_Y, STRIP_WIDTH = -0.07, 9.0
STRIP_SHORTEST = 0.003
"""Half of the shortest visible range on the strip, as a share of its length; otherwise single frames are too thin."""
P_LEVELS = (("below 10 %", 0.0, 0.1, GREEN), ("10 to 50 %", 0.1, 0.5, BLUE), ("above 50 %", 0.5, np.inf, ACCENT))
"""Levels of p_off on the chart of the path: name, lowest value, end, colour."""
STATES_CAPTION = (
    "The strip shows the state of each frame. The line and the colours along the path show the probability that a pose "
    "is off by more than 5 cm. Lost frames and frames apart have no place on the path."
)

Plot = tuple[list[Chart], str]
"""Charts and their caption."""


def run_charts(frames: RunFrames, truth: Matrix | None) -> dict[str, Plot]:
    """Return the charts of a run with captions, by name: trajectory, and states if known; none without a valid frame.

    truth: [B, 3] of the valid frames, as in `trajectory_charts`.
    """
    if not len(frames.rows):
        return {}
    estimate = frames.path.T_world_camera[:, :3, 3]
    before_lost = np.array([row + 1 < len(frames) and frames.states[row + 1] == LOST for row in frames.rows], np.bool_)
    caption = "In the frame of the first camera." + ("" if truth is None else " The recorded path is rigidly aligned.")
    if before_lost.any():
        caption += " A dot marks the last pose before tracking was lost."
    found = {"trajectory": (trajectory_charts(estimate, truth, before_lost), caption)}
    if len(set(frames.states)) > 1 or np.isfinite(frames.p_off).any():
        found["states"] = state_charts(frames), STATES_CAPTION
    return found


def trajectory_charts(estimate: Matrix, truth: Matrix | None, lost: NDArray[np.bool_] | None = None) -> list[Chart]:
    """Return the charts of a path from above (x right, z forward) and of its height (−y) over frames.

    estimate: positions [N, 3], metres, in the frame of the first camera; truth: positions [N, 3] of the same frames,
    aligned to the estimate, nan if unknown; lost: frames [N] to mark as the place where tracking was lost.
    """
    top, height = [], []
    frames = np.arange(len(estimate))
    if truth is not None:
        top.append(Curve("recorded", truth[:, [0, 2]], BLUE))
        height.append(Curve("recorded", np.stack([frames, -truth[:, 1]], 1), BLUE))
    rise = np.stack([frames, -estimate[:, 1]], 1)
    top.append(Curve("estimate", estimate[:, [0, 2]], ACCENT))
    height.append(Curve("estimate", rise, ACCENT))
    if lost is not None and lost.any():
        top.append(Curve("lost", estimate[lost][:, [0, 2]], PURPLE, dots=True))
        height.append(Curve("lost", rise[lost], PURPLE, dots=True))
    return [
        Chart("Path from above", "right, m", "forward, m", top, square=True),
        Chart("Height", "frame", "up, m", height),
    ]


def state_charts(frames: RunFrames) -> list[Chart]:
    """Return the charts of the states: as a coloured strip over the frames with p_off, and p_off along the path."""
    numbers = np.array([record["index"] for record in frames.log], np.float64)
    curves = [Curve("", np.stack([numbers, frames.p_off], 1), FAINT, width=1.5)]
    for state in STATE_COLOURS:
        curves += _strip(state, numbers, np.array(frames.states) == state)
    over_frames = Chart("State of each frame", "frame", "", curves, y_limits=(-0.12, 1.04))
    return [over_frames, _p_off_chart(frames)]


def _strip(state: str, numbers: Matrix, at: NDArray[np.bool_]) -> list[Curve]:
    """Return one thick line per uninterrupted range of frames in a state; only the first one is named."""
    edges = np.diff(np.r_[False, at, False].astype(int))
    half = 0.5 if state == TRACKED else max(0.5, STRIP_SHORTEST * np.ptp(numbers))
    ranges = zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1, strict=True)
    return [
        Curve("" if i else state, np.array([[numbers[a] - half, STRIP_Y], [numbers[b] + half, STRIP_Y]]),
              STATE_COLOURS[state], width=STRIP_WIDTH)
        for i, (a, b) in enumerate(ranges)
    ]  # fmt: skip


def _p_off_chart(frames: RunFrames) -> Chart:
    """Return the chart of the valid path from above, in one colour per level of p_off."""
    top, p = frames.path.T_world_camera[:, [0, 2], 3], frames.p_off[frames.rows]
    curves = [Curve("", top, FAINT, width=1.5)]
    for name, low, high, colour in P_LEVELS:
        at = (p >= low) & (p < high)
        if at.any():
            curves.append(Curve(name, top[at], colour, dots=True))
    return Chart("Probability along the path", "right, m", "forward, m", curves, square=True)
