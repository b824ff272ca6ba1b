"""Tabulate the results of relocalisation.py."""

from collections.abc import Callable
from typing import Any

from tables import Section

NAMES = {"orb": "ORB", "sift": "RootSIFT", "xfeat-nearest": "XFeat, nearest neighbours", "xfeat": "XFeat, LighterGlue"}
RIGHT = "Right: within 10 cm and 5° of the true pose."


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results."""
    listed = measured["figures"]["sequences"]
    made = []
    if "kinds" in listed[0]:
        ms = "Finding the features of one image + matching two images + pose."
        many = "Poses that are not right although at least 15 matches support them: inliers alone prove nothing."
        made += [
            table("Candidate given: right poses, %", listed, "kinds", lambda k: f"{k['right_percent']:.0f}", RIGHT),
            table("Candidate given: wrong poses, %", listed, "kinds", lambda k: f"{k['wrong_percent']:.0f}", many),
            table("Candidate given: CPU ms", listed, "kinds", parts, ms),
        ]
    if "map" in listed[0]:
        made += [
            table("Whole map: found, %", listed, "map", lambda k: f"{k['right_percent']:.0f}", RIGHT),
            table("Whole map: false, %", listed, "map", lambda k: f"{k['false_percent']:.1f}", "Accepted, not right."),
            table(
                "Whole map: CPU ms",
                listed,
                "map",
                lambda k: f"{k['cpu_ms']:.0f}",
                "One search without finding features, median.",
            ),
        ]
    return made


def table(
    title: str, listed: list[dict[str, Any]], part: str, text: Callable[[dict[str, Any]], str], note: str
) -> Section:
    """Return a table with a row for each sequence and a column for each kind of features."""
    kinds = list(listed[0][part])
    rows = [[sequence["source"], *(text(sequence[part][kind]) for kind in kinds)] for sequence in listed]
    return Section(title, ["sequence", *(NAMES[kind] for kind in kinds)], rows, note)


def parts(kind: dict[str, Any]) -> str:
    """Write the CPU time of each part, milliseconds."""
    return " + ".join(f"{kind['cpu_ms'][part]:.0f}" for part in ("find", "match", "pose"))
