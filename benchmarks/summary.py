"""Summarise the results on one screen: each figure is copied from a table, to which its row links.

`tables.py` writes the summary where a document has <!-- bench:summary -->.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import claims_tables
import record
import tables
from ablation import verdict_counts
from result_pages import link

SEQUENCES = ("livingroom", "synthetic", "redkitchen")


@dataclass(frozen=True)
class Results:
    """The results of a folder, read table by table."""

    folder: Path

    def measured(self, name: str) -> dict[str, Any]:
        """Return the newest results of a name. Raises KeyError if there are none."""
        found = record.latest(name, self.folder)
        if found is None:
            raise KeyError(f"the summary needs the results {name!r}")
        return found

    def cell(self, name: str, title: str, row: Sequence[str], column: str) -> str:
        """Return a cell of a table, from the first row that begins with `row`. Raises KeyError if there is none."""
        for section in tables.sections(self.measured(name)):
            for cells in section.rows if section.title == title and column in section.columns else ():
                if tuple(cells[: len(row)]) == tuple(row):
                    return cells[list(section.columns).index(column)].strip("*")
        raise KeyError(f"the summary needs {column!r} of {', '.join(row)} in table {title!r} of {name}")

    def each(self, title: str, column: str) -> str:
        """Return a figure of the preset sigma on each sequence of the accuracy benchmark."""
        return " · ".join(self.cell("accuracy", title, (name, "sigma"), column) for name in SEQUENCES)


def weights_of_variance(results: Results) -> str:
    """Count the figures that the weights of σ² change over the sequences."""
    measured = results.measured("ablation")
    earlier = verdict_counts(measured, "+registration", "none")
    final = verdict_counts(measured, "+final", "+registration")
    return (
        f"with σ² in tracking, loops and registration {earlier['helps']} of {earlier.total()} figures are better, "
        f"{earlier['harms']} worse, the others without clear effect; with σ² in the final map too {final['helps']} "
        f"better, {final['harms']} worse of {final.total()}"
    )


def uses_of_uncertainty(results: Results) -> str:
    """Name the uses of an uncertainty that help or harm over the sequences."""
    (verdicts,) = (s for s in tables.sections(results.measured("weights")) if s.title == "Verdicts")
    by = {word: [row[0] for row in verdicts.rows if row[1] == word] for word in ("helps", "harms", "mixed")}
    named = "; ".join(f"{word}: {', '.join(found) or '–'}" for word, found in by.items())
    return f"of {len(verdicts.rows)} changes, {named}; the others have no clear effect"


def claims(results: Results) -> str:
    """Count the verdicts on the claims of each paper."""
    counts = {paper: claims_tables.verdict_counts(paper, results.folder) for paper in claims_tables.PAPERS}
    return "; ".join(
        f"{paper}: {count[claims_tables.HOLDS]} of {count.total()} hold, {count[claims_tables.OPPOSITE]} show the "
        f"opposite, {count[claims_tables.UNCLEAR]} no clear effect, the others could not be tested"
        for paper, count in counts.items()
    )


def alignment(results: Results) -> str:
    """Compare tracking by alignment with tracking by Adam."""
    row = ("1", "Gauss–Newton, keyframe")
    ratio = results.cell("tracking", "Ratios", row, "translation error / Adam's")
    ms = [results.cell("tracking", "Pairs", ("1", method), "ms, median") for method in (row[1], "Adam, TUM's rates")]
    return f"one frame after the keyframe: {ratio} × Adam's translation error, {ms[0]} ms instead of {ms[1]} ms"


def coverage(results: Results) -> str:
    """Return the share of motions over 50 frames whose error lies in the 90 % ellipsoid of the covariance."""
    rooms, kitchen, desk = (
        results.cell("pose-covariance", "Covariance of poses", (recording, "50 frames"), "in the 90 % ellipsoid, %")
        for recording in ("mean of the rooms with noise", "redkitchen", "fr1_xyz")
    )
    return (
        f"**not with a real sensor**: 90 % should be covered, {rooms} % are in rendered rooms, {kitchen} % on "
        f"redkitchen, {desk} % on fr1_xyz"
    )


def disturbed(results: Results) -> str:
    """Return what becomes of disturbed recordings."""
    lost, silent = (
        results.cell("robustness", "Suite", (row,), "all") for row in ("frames lost, %", "silent failures, % of frames")
    )
    return f"{lost} % of the frames are declared lost, {silent} % are off by more than 10 cm without being declared"


def broken(results: Results) -> str:
    """Return how many mutated files end in a traceback, and how many killed runs end as if they had not been killed."""
    inputs = results.measured("fuzz")["figures"]["inputs"]
    tracebacks = results.cell("fuzz", "Mutated inputs", (f"all {inputs}",), "traceback")
    kills = [
        [results.cell("crashes", "Crashes", (how, "**all**"), column) for column in ("same end", "cases")]
        for how in ("kill -9", "power failure")
    ]
    same = " and ".join(f"{end} of {cases}" for end, cases in kills)
    return f"{inputs} mutated files: {tracebacks} tracebacks; killed runs and power failures that end the same: {same}"


def loops(results: Results) -> str:
    """Return the effect of loop closure on the path under drift."""
    ratio = results.cell("loops", "Goals", ("drift: ATE with loops / without, of means",), "measured")
    wrong = results.cell("loops", "Goals", ("drift: false loops closed, all seeds",), "measured")
    seeds = len(results.measured("loops")["seeds"])
    return f"ATE × {ratio} (rooms with drift, mean of {seeds} seeds); false loops closed: {wrong}"


def kernels(results: Results) -> str:
    """Return the times of the main operations."""
    columns = {
        "render all outputs": "forward, all outputs",
        "track a frame": "track, Gauss–Newton",
        "mapping iteration": "mapping iteration",
    }
    ms = {what: results.cell("cpu", "Times, ms", ("77 k, 320×240",), column) for what, column in columns.items()}
    return f"77 k splats at 320×240: {', '.join(f'{what} {value} ms' for what, value in ms.items())}"


def growth(results: Results) -> str:
    """Return how time and memory grow over a long run."""
    column = "measured"
    frames, time, memory = (
        results.cell("long-run", "Goals", (row,), column) for row in ("frames", "… mean", "resident memory, median")
    )
    return f"{frames} frames: the last quarter takes {time} × the time of the second, {memory} × its memory"


def each(title: str, column: str) -> Callable[[Results], str]:
    """Return a figure of the preset sigma on each sequence."""
    return lambda results: results.each(title, column)


PATH, MAP = "Path and speed", "Map and uncertainty"
ROWS: tuple[tuple[str, Callable[[Results], str], tuple[str, ...]], ...] = (
    ("Error of the path (ATE), cm", each(PATH, "ATE, cm"), ("accuracy",)),
    ("Frames per second, without the final map", each(PATH, "frames/s"), ("accuracy",)),
    ("Peak memory, MiB", each(PATH, "peak memory, MiB"), ("accuracy",)),
    ("Held-out views, PSNR, dB", each(MAP, "PSNR held-out, dB"), ("accuracy",)),
    ("Held-out views, depth L1, cm", each(MAP, "depth L1 held-out, cm"), ("accuracy",)),
    ("Does V rank the errors? (Spearman, 1 = perfectly)", each(MAP, "Spearman V ~ error²"), ("accuracy",)),
    ("Does the covariance of poses cover the error?", coverage, ("pose-covariance",)),
    ("Do the weights of σ² help?", weights_of_variance, ("ablation",)),
    ("Which other uses of an uncertainty help?", uses_of_uncertainty, ("weights",)),
    ("Which claims of the papers hold here?", claims, ("verdicts",)),
    ("Alignment or Adam for tracking?", alignment, ("tracking",)),
    ("Do loops help?", loops, ("loops",)),
    ("What becomes of disturbed recordings?", disturbed, ("robustness",)),
    ("How fast are the kernels?", kernels, ("cpu",)),
    ("Does a long run slow down?", growth, ("long-run", "viewer-memory")),
    ("Do broken files or kills do harm?", broken, ("fuzz", "crashes")),
)  # fmt: skip
"""Question, answer, and the results that the answer is taken from."""


def table(folder: Path = record.RESULTS) -> str:
    """Write the summary as a markdown table. Raises KeyError if a result is missing."""
    results = Results(folder)
    head = ["question", f"result ({' · '.join(SEQUENCES)})", "tables"]
    lines = [head, ["---"] * 3]
    for question, answer, names in ROWS:
        lines.append([question, answer(results), ", ".join(link(name, "results/") for name in names)])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
