"""Tabulate the results of relocalisation.py."""

from typing import Any

from tables import Section

RIGHT = "Right: within 10 cm and 5° of the true pose. "
GIVEN = (
    "Wrong: poses that are not right although at least 15 matches support them: inliers alone prove nothing. Times: "
    "finding the features of one image + matching two images + pose."
)
MAP = "False: accepted, not right. Time: one search without finding features, median."


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results."""
    listed, made = measured["figures"]["sequences"], list[Section]()
    if "given" in listed[0]:
        rows = [
            [s["source"], f"{g['right_percent']:.0f}", f"{g['wrong_percent']:.0f}", parts(g)]
            for s in listed
            for g in (s["given"],)
        ]
        made.append(Section("Candidate given", ["sequence", "right, %", "wrong, %", "CPU ms"], rows, RIGHT + GIVEN))
    if "map" in listed[0]:
        rows = [
            [s["source"], f"{m['right_percent']:.0f}", f"{m['false_percent']:.1f}", f"{m['cpu_ms']:.0f}"]
            for s in listed
            for m in (s["map"],)
        ]
        made.append(Section("Whole map", ["sequence", "found, %", "false, %", "CPU ms"], rows, RIGHT + MAP))
    return made


def parts(given: dict[str, Any]) -> str:
    """Write the CPU time of each part, milliseconds."""
    return " + ".join(f"{given['cpu_ms'][part]:.0f}" for part in ("find", "match", "pose"))
