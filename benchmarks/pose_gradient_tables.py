"""Lay out what pose_gradient.py measured: poses and times by the paths that the gradient has."""

from typing import Any

import numpy as np
from accuracy_tables import PLACE, spread, values_of
from tables import Section, significant

Rows = list[dict[str, Any]]
RUN = (*(figure for figure in PLACE if figure[1] in ("ate_m", "rpe_m", "rpe_deg", "lost")),
       ("ms per iteration", "ms_per_iteration", 1.0))  # fmt: skip
"""Title, name of the figure, factor."""
ERRORS = ("translation_cm", "rotation_deg")
FIRST = "mean + depth"
"""What the other ways are held against."""


def sequences(jobs: Rows) -> Section:
    """Lay out whole runs by sequence and way."""
    rows = []
    for source, way in dict.fromkeys((job["source"], job["way"]) for job in jobs):
        done = [job for job in jobs if (job["source"], job["way"], job["problem"]) == (source, way, None)]
        cells = [spread([factor * value for value in values_of(done, name)]) for _, name, factor in RUN]
        rows.append([source, way, str(len(done)), *cells])
    head = ["sequence", "paths", "runs", *(title for title, _, _ in RUN)]
    rows.sort(key=lambda row: [job["source"] for job in jobs].index(row[0]))
    return Section("Sequences", head, rows, "Mean ± standard deviation over the runs, which differ by their seed.")


def pairs_of(maps: Rows, way: str, figure: str) -> tuple[list[float], list[float]]:
    """Collect a figure of every frame by a way, and beside it of the same frames by the first."""
    ours, firsts = ([f[figure] for m in maps for f in m["found"] if f["way"] == w] for w in (way, FIRST))
    return ours, firsts


def localisation(measured: Rows) -> Section:
    """Lay out the errors of single frames: medians over frames and seeds, and how many a way brings nearer."""
    rows = []
    for source in measured:
        maps = source["maps"]
        for way in dict.fromkeys(found["way"] for found in maps[0]["found"]):
            cells = [str(len(pairs_of(maps, way, "ms")[0]))]
            fitted = bool(max(pairs_of(maps, way, "ms")[0]))
            for error in ERRORS:
                ours, firsts = pairs_of(maps, way, error)
                nearer = 100.0 * float(np.mean(np.less(ours, firsts))) if fitted and way != FIRST else None
                cells += [significant(float(np.median(ours))), significant(nearer, 2)]
            cells.append(significant(float(np.median(pairs_of(maps, way, "ms")[0])) if fitted else None))
            rows.append([source["source"], way, *cells])
    head = ["sequence", "paths", "frames", "cm, median", "nearer, %", "°, median", "nearer, %", "ms per iteration"]
    note = f"Nearer: of the frames, those that {FIRST} leave farther from the truth. "
    return Section("Localisation", head, rows, note + harmonics_of(measured))


def paths(measured: Rows) -> Section:
    """Lay out how large each path's gradient is where the search begins."""
    rows = []
    for source in measured:
        found = [part for m in source["maps"] for part in m["shares"]]
        for path in found[0]:
            medians = np.median([part[path] for part in found], 0)
            rows.append([source["source"], path, *(significant(100.0 * float(share)) for share in medians)])
    head = ["sequence", "path alone", "of the gradient by ρ, %", "… by φ, %"]
    return Section("Paths", head, rows, "Length over that of all paths together, median; paths may pull apart.")


def harmonics_of(measured: Rows) -> str:
    """Say how much the maps' colours depend on the direction."""
    shares = [f"{s['source']} {np.mean([m['view_dependence'] for m in s['maps']]):.4f}" for s in measured]
    return f"Harmonics change a picture by, mean absolute colour: {', '.join(shares)}."


def failures(jobs: Rows) -> Section:
    """List the runs that failed, with what they said last."""
    failed = [job for job in jobs if job["problem"] is not None]
    rows = [[f"{j['source']}, {j['way']}, seed {j['seed']}", j["problem"].replace("|", "/")] for j in failed]
    return Section("Failed", ["run", "last words"], rows)


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by pose_gradient.py."""
    jobs, found = (measured["figures"].get(name, []) for name in ("sequence", "localise"))
    made = [sequences(jobs), localisation(found), paths(found), failures(jobs)]
    return [section for section in made if section.rows]
