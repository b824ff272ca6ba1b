"""Prepare the charts of a run: path from above, height, submaps and loops, seconds per frame."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sigmasplat.drawing.plot import ACCENT, BLUE, FAINT, GREEN, PURPLE, Chart, Curve
from sigmasplat.types import Matrix

SUBMAP_COLOURS = (BLUE, GREEN, PURPLE)
"""Neighbouring submaps get different colours; the accent colour is for loops."""
MAX_LABELS = 24
SUBMAPS_CAPTION = (
    "The final path. The colour changes from submap to submap, and each number marks the start of a submap. "
    "A line connects two frames that were compared as a loop."
)


class LoopLink(NamedTuple):
    """A loop between two frames, as rows of the path, and whether it was accepted."""

    query: int
    database: int
    accepted: bool


Log = list[dict[str, Any]]


def run_charts(
    log: Log, estimate: Matrix, truth: Matrix | None, loops: Sequence[dict[str, Any]] = ()
) -> dict[str, tuple[list[Chart], str]]:
    """Return the charts of a run with captions, by name: trajectory; submaps if there are several; seconds if known.

    log: records with `row`, their row in the whole log, to which the frames of loops refer; estimate, truth: [N, 3] of
    these records, as in `trajectory_charts`.
    """
    lost = np.array([bool(record.get("lost")) for record in log])
    caption = "In the frame of the first camera." + ("" if truth is None else " The true path is rigidly aligned.")
    found = {"trajectory": (trajectory_charts(estimate, truth, lost), caption)}
    submaps = np.array([record.get("submap", 0) for record in log])
    if submaps.max() > 0:
        found["submaps"] = [submap_chart(estimate, submaps, _known_links(log, loops))], SUBMAPS_CAPTION
    if any(frame_seconds(record) for record in log):
        stages = {name: np.array([(r.get("seconds") or {}).get(name, 0.0) for r in log]) for name in _stages(log)}
        stages["total"] = np.array([frame_seconds(record) for record in log])
        caption = "Seconds per frame, end to end. Keyframes take longer, because mapping runs on them."
        found["seconds"] = [seconds_chart(np.array([record["index"] for record in log]), stages)], caption
    return found


def frame_seconds(record: dict[str, Any]) -> float:
    """Return the time of one frame: its `total`, or the sum of its stages."""
    stages: dict[str, float] = record.get("seconds") or {}
    return float(stages.get("total", sum(stages.values())))


def _stages(log: Log) -> list[str]:
    """Return the names of the first three timed stages."""
    return [name for name in (log[0].get("seconds") or {}) if name != "total"][:3]


def _known_links(log: Log, loops: Sequence[dict[str, Any]]) -> list[LoopLink]:
    """Return the loops of which both frames have a pose."""
    place = {record["row"]: i for i, record in enumerate(log)}
    ends = [(place.get(loop["query_frame"]), place.get(loop["database_frame"]), loop["accepted"]) for loop in loops]
    return [LoopLink(a, b, bool(accepted)) for a, b, accepted in ends if a is not None and b is not None]


def trajectory_charts(estimate: Matrix, truth: Matrix | None, lost: NDArray[np.bool_] | None = None) -> list[Chart]:
    """Return the charts of a path from above (x right, z forward) and of its height (−y) over frames.

    estimate: positions [N, 3], metres, in the frame of the first camera; truth: positions [N, 3] of the same frames,
    aligned to the estimate, nan if unknown; lost: frames [N] to mark.
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
