"""Prepare the charts of a run: path from above, height, submaps and loops, seconds per frame."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import APART, LOST, RELOCALISED, TRACKED, Matrix, RunFrames, frame_seconds
from sigmasplat.plugins.outputs.drawing.plot import ACCENT, BLUE, FAINT, GREEN, PURPLE, Chart, Curve

SUBMAP_COLOURS = (BLUE, GREEN, PURPLE)
"""Neighbouring submaps get different colours; the accent colour is for loops."""
STATE_COLOURS = {TRACKED: GREEN, APART: PURPLE, LOST: ACCENT, RELOCALISED: BLUE}
"""In the order of drawing."""
STRIP_Y, STRIP_WIDTH = -0.07, 9.0
STRIP_SHORTEST = 0.003
"""Half of the shortest visible range on the strip, as a share of its length; otherwise single frames are too thin."""
P_LEVELS = (("below 10 %", 0.0, 0.1, GREEN), ("10 to 50 %", 0.1, 0.5, BLUE), ("above 50 %", 0.5, np.inf, ACCENT))
"""Levels of p_off on the chart of the path: name, lowest value, end, colour."""
MAX_LABELS = 24
STATES_CAPTION = (
    "The strip shows the state of each frame. The line and the colours along the path show the probability that a pose "
    "is off by more than 5 cm. Lost frames and frames apart have no place on the path."
)
SUBMAPS_CAPTION = (
    "The final path. The colour changes from submap to submap, and each number marks the start of a submap. "
    "A line connects two frames that were compared as a loop."
)

MOVING_CAPTION = (
    "The share of each image that was taken for moving. It was used neither for the path nor for the map. What stays "
    "in its place for a while becomes part of the map again."
)


class LoopLink(NamedTuple):
    """A loop between two frames, as rows of the path, and whether it was accepted."""

    query: int
    database: int
    accepted: bool


Log = list[dict[str, Any]]
Plot = tuple[list[Chart], str]
"""Charts and their caption."""


def run_charts(frames: RunFrames, truth: Matrix | None, loops: Sequence[dict[str, Any]] = ()) -> dict[str, Plot]:
    """Return the charts of a run with captions, by name: trajectory; states if known; submaps if there are several;
    moving if anything moved; seconds if known. Without a valid frame there are only the seconds.

    truth: [B, 3] of the valid frames, as in `trajectory_charts`.
    """
    log = frames.log
    found = _path_charts(frames, truth, loops) if len(frames.rows) else {}
    shares = np.array([(record.get("tracking") or {}).get("moving", 0.0) for record in log])
    if shares.any():
        found["moving"] = [moving_chart(np.array([record["index"] for record in log]), shares)], MOVING_CAPTION
    if any(frame_seconds(record) for record in log):
        stages = {name: np.array([(r.get("seconds") or {}).get(name, 0.0) for r in log]) for name in _stages(log)}
        stages["total"] = np.array([frame_seconds(record) for record in log])
        caption = "Seconds per frame, end to end. Keyframes take longer, because mapping runs on them."
        found["seconds"] = [seconds_chart(np.array([record["index"] for record in log]), stages)], caption
    return found


def _path_charts(frames: RunFrames, truth: Matrix | None, loops: Sequence[dict[str, Any]]) -> dict[str, Plot]:
    estimate, log = frames.path.T_world_camera[:, :3, 3], frames.log
    before_lost = np.array([row + 1 < len(frames) and frames.states[row + 1] == LOST for row in frames.rows], np.bool_)
    caption = "In the frame of the first camera." + ("" if truth is None else " The true path is rigidly aligned.")
    if before_lost.any():
        caption += " A dot marks the last pose before tracking was lost."
    found = {"trajectory": (trajectory_charts(estimate, truth, before_lost), caption)}
    if len(set(frames.states)) > 1 or np.isfinite(frames.p_off).any():
        found["states"] = state_charts(frames), STATES_CAPTION
    submaps = np.array([log[row].get("submap", 0) for row in frames.rows])
    if submaps.max() > 0:
        found["submaps"] = [submap_chart(estimate, submaps, _known_links(frames, loops))], SUBMAPS_CAPTION
    return found


def _stages(log: Log) -> list[str]:
    """Return the names of the first three timed stages."""
    return [name for name in (log[0].get("seconds") or {}) if name != "total"][:3]


def _known_links(frames: RunFrames, loops: Sequence[dict[str, Any]]) -> list[LoopLink]:
    place = {row: i for i, row in enumerate(frames.rows.tolist())}
    ends = [(place.get(loop["query_frame"]), place.get(loop["database_frame"]), loop["accepted"]) for loop in loops]
    return [LoopLink(a, b, bool(accepted)) for a, b, accepted in ends if a is not None and b is not None]


def trajectory_charts(estimate: Matrix, truth: Matrix | None, lost: NDArray[np.bool_] | None = None) -> list[Chart]:
    """Return the charts of a path from above (x right, z forward) and of its height (−y) over frames.

    estimate: positions [N, 3], metres, in the frame of the first camera; truth: positions [N, 3] of the same frames,
    aligned to the estimate, nan if unknown; lost: frames [N] to mark as the place where tracking was lost.
    """
    top, height = [], []
    frames = np.arange(len(estimate))
    if truth is not None:
        top.append(Curve("truth", truth[:, [0, 2]], BLUE))
        height.append(Curve("truth", np.stack([frames, -truth[:, 1]], 1), BLUE))
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
        Curve(
            "" if i else state,
            np.array([[numbers[a] - half, STRIP_Y], [numbers[b] + half, STRIP_Y]]),
            STATE_COLOURS[state],
            width=STRIP_WIDTH,
        )
        for i, (a, b) in enumerate(ranges)
    ]


def _p_off_chart(frames: RunFrames) -> Chart:
    """Return the chart of the valid path from above, in one colour per level of p_off."""
    top, p = frames.path.T_world_camera[:, [0, 2], 3], frames.p_off[frames.rows]
    curves = [Curve("", top, FAINT, width=1.5)]
    for name, low, high, colour in P_LEVELS:
        at = (p >= low) & (p < high)
        if at.any():
            curves.append(Curve(name, top[at], colour, dots=True))
    return Chart("Probability along the path", "right, m", "forward, m", curves, square=True)


def moving_chart(frames: NDArray[np.int_], shares: Matrix) -> Chart:
    """Return the chart of the share of each image that was taken for moving: frames [N], shares [N]."""
    curve = Curve("", np.stack([frames, 100 * shares], 1).astype(np.float64), ACCENT)
    return Chart("Taken for moving", "frame", "% of the image", [curve], from_zero=True)


def seconds_chart(frames: NDArray[np.int_], stages: dict[str, Matrix]) -> Chart:
    """Return the chart of seconds per frame: frames [N], seconds [N] by stage; "total" has the accent colour."""
    curves = [
        Curve(name, np.stack([frames, seconds], 1).astype(np.float64), ACCENT if name == "total" else i % 3 + 1)
        for i, (name, seconds) in enumerate(stages.items())
    ]
    return Chart("Seconds per frame", "frame", "", curves, from_zero=True)


def submap_chart(estimate: Matrix, submaps: NDArray[np.int_], links: Sequence[LoopLink]) -> Chart:
    """Return the chart of a path from above, with submaps in colours with their numbers, and tried loops as lines.

    estimate: positions [N, 3], metres; submaps [N]: the submap of each frame, increasing.
    """
    top = estimate[:, [0, 2]]
    first = np.flatnonzero(np.diff(submaps, prepend=submaps[0] - 1))
    last = np.minimum([*first[1:], len(top)], len(top) - 1)  # each line ends at the first frame of the next submap
    path = [
        Curve("", top[a : b + 1], SUBMAP_COLOURS[int(submaps[a]) % len(SUBMAP_COLOURS)], width=3.0)
        for a, b in zip(first, last, strict=True)
    ]
    labelled = first[:: -(-len(first) // MAX_LABELS)]
    labels = {str(submaps[a]): (float(top[a, 0]), float(top[a, 1])) for a in labelled}
    refused = _links(top, "loop refused", [link for link in links if not link.accepted], FAINT)
    accepted = _links(top, "loop accepted", [link for link in links if link.accepted], ACCENT)
    curves = [*refused, *path, *accepted]
    return Chart("Submaps from above", "right, m", "forward, m", curves, square=True, labels=labels)


def _links(top: Matrix, name: str, links: Sequence[LoopLink], colour: int) -> list[Curve]:
    """Return loops as lines; only the first one is named, so that the legend has one entry."""
    return [
        Curve("" if i else name, top[[link.query, link.database]], colour, width=1.0 if colour == FAINT else 2.0)
        for i, link in enumerate(links)
    ]
