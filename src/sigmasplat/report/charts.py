"""Lay out the charts of a run: the path from above and its height, submaps and loops, seconds per frame."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sigmasplat.drawing.plot import ACCENT, BLUE, FAINT, GREEN, PURPLE, Chart, Curve
from sigmasplat.types import Matrix

SUBMAP_COLOURS = (BLUE, GREEN, PURPLE)
"""Neighbours differ; the accent is for loops."""
MOST_LABELS = 24
SUBMAPS_CAPTION = (
    "The path as it is in the end, each submap in another colour than the one before, its number where it begins. "
    "Lines join the frames by which two submaps were taken for one place."
)


class Link(NamedTuple):
    """A loop between two frames, given as rows of the path, and whether it was believed."""

    query: int
    database: int
    accepted: bool


Log = list[dict[str, Any]]


def of_run(
    log: Log, estimate: Matrix, truth: Matrix | None, loops: Sequence[dict[str, Any]] = ()
) -> dict[str, tuple[list[Chart], str]]:
    """Return a run's charts with captions, by name: trajectory; submaps where there are several; seconds where timed.

    log: records with `row`, their place in the whole log, which the frames of loops count; estimate, truth: [N, 3] of
    these records, as `trajectory_charts` takes them.
    """
    lost = np.array([bool(record.get("lost")) for record in log])
    caption = "In the frame of the first camera." + ("" if truth is None else " The truth is rigidly aligned.")
    found = {"trajectory": (trajectory_charts(estimate, truth, lost), caption)}
    submaps = np.array([record.get("submap", 0) for record in log])
    if submaps.max() > 0:
        found["submaps"] = [submap_chart(estimate, submaps, _known_links(log, loops))], SUBMAPS_CAPTION
    if any(seconds_of(record) for record in log):
        stages = {name: np.array([(r.get("seconds") or {}).get(name, 0.0) for r in log]) for name in _stages(log)}
        stages["total"] = np.array([seconds_of(record) for record in log])
        caption = "Seconds each frame took, end to end; keyframes carry the mapping."
        found["seconds"] = [seconds_chart(np.array([record["index"] for record in log]), stages)], caption
    return found


def seconds_of(record: dict[str, Any]) -> float:
    """Return the time one frame took: its `total`, or the sum of its stages."""
    stages: dict[str, float] = record.get("seconds") or {}
    return float(stages.get("total", sum(stages.values())))


def _stages(log: Log) -> list[str]:
    """Return the names of the first three stages timed."""
    return [name for name in (log[0].get("seconds") or {}) if name != "total"][:3]


def _known_links(log: Log, loops: Sequence[dict[str, Any]]) -> list[Link]:
    """Return the loops whose frames both have a pose."""
    place = {record["row"]: i for i, record in enumerate(log)}
    ends = [(place.get(loop["query_frame"]), place.get(loop["database_frame"]), loop["accepted"]) for loop in loops]
    return [Link(a, b, bool(accepted)) for a, b, accepted in ends if a is not None and b is not None]


def trajectory_charts(estimate: Matrix, truth: Matrix | None, lost: NDArray[np.bool_] | None = None) -> list[Chart]:
    """Lay out a path from above (x right, z forward) and its height (−y) over frames.

    estimate: positions [N, 3], metres, in the first camera's frame; truth: the same frames' [N, 3], aligned to it, nan
    where unknown; lost: frames [N] to mark.
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
    """Lay out the seconds each frame took, by stage: frames [N], seconds [N] per stage; "total" stands out."""
    curves = [
        Curve(name, np.stack([frames, seconds], 1).astype(np.float64), ACCENT if name == "total" else i % 3 + 1)
        for i, (name, seconds) in enumerate(stages.items())
    ]
    return Chart("Seconds per frame", "frame", "", curves, from_zero=True)


def submap_chart(estimate: Matrix, submaps: NDArray[np.int_], links: Sequence[Link]) -> Chart:
    """Lay out a path from above, each submap in its colour with its number, and the loops tried as lines across.

    estimate: positions [N, 3], metres; submaps [N]: which one each frame belongs to, growing.
    """
    top = estimate[:, [0, 2]]
    first = np.flatnonzero(np.diff(submaps, prepend=submaps[0] - 1))
    last = np.minimum([*first[1:], len(top)], len(top) - 1)  # each reaches to the next one's first frame
    path = [
        Curve("", top[a : b + 1], SUBMAP_COLOURS[int(submaps[a]) % len(SUBMAP_COLOURS)], width=3.0)
        for a, b in zip(first, last, strict=True)
    ]
    labelled = first[:: -(-len(first) // MOST_LABELS)]
    labels = {str(submaps[a]): (float(top[a, 0]), float(top[a, 1])) for a in labelled}
    refused = _links(top, "loop refused", [link for link in links if not link.accepted], FAINT)
    accepted = _links(top, "loop accepted", [link for link in links if link.accepted], ACCENT)
    curves = [*refused, *path, *accepted]
    return Chart("Submaps from above", "right, m", "forward, m", curves, square=True, labels=labels)


def _links(top: Matrix, name: str, links: Sequence[Link], colour: int) -> list[Curve]:
    """Draw links as lines; the first one stands in the legend for all."""
    return [
        Curve("" if i else name, top[[link.query, link.database]], colour, width=1.0 if colour == FAINT else 2.0)
        for i, link in enumerate(links)
    ]
