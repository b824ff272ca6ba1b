"""Write committed results as markdown tables into the documents, and check that the documents are up to date.

A document holds <!-- bench:NAME --> … <!-- /bench -->, or bench:NAME/SECTION for one table of several;
`python benchmarks/tables.py` replaces the text between them, in README.md and docs/*.md. NAME is the name of results
(the newest from any machine) or a file name without .json; SECTION is the title of a table, as in path-and-speed.
bench:* shows all results, each under its own heading, and bench:contents lists these headings; bench:summary is the
table of summary.py, bench:verdicts those of claims_tables.py.
"""

import ast
import importlib
import math
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import record
import tyro

SUBJECTS = {
    "A change": ("board",),
    "Whole runs": ("accuracy", "pace", "systems", "map_quality", "full_resolution", "every_preset", "paper_presets"),
    "Other systems": ("peers", "peer_pace", "mesh_quality"),
    "Claims of the papers": ("claims",),
    "Effect of σ²": ("ablation", "weights"),
    "Uncertainty": ("uncertainty", "uncertainty_weights", "pose_covariance"),
    "Camera tracking": ("tracking", "pose_gradient", "relocalisation"),
    "Robustness": ("robustness", "failure_probability", "fuzz"),
    "Loops and submaps": ("loops", "drift_rule"),
    "Consistent maps": ("consistency",),
    "Exported maps": ("export_sizes",),
    "Geometry": ("four_frames", "away_from_path"),
    "Kernels": ("cpu", "roofline", "versus", "gpu", "kernels"),
    "Real time": ("realtime", "long_live"),
    "Depth noise": ("sensor_models",),
    "Stereo": ("stereo",),
    "RGB only": ("predicted",),
    "Known poses": ("given_poses",),
    "Moving things": ("moving", "composites", "search_cost"),
    "Long runs": ("long_run", "endurance", "viewer_memory"),
    "Start-up": ("startup",),
    "Killed runs": ("crashes",),
}
"""Benchmarks by the subject under which their results are listed, in this order; all others follow at the end."""
BLOCK = re.compile(r"(<!-- bench:(?P<what>[\w./+-]+|\*) -->\n)(?P<body>.*?)(<!-- /bench -->)", re.DOTALL)


@dataclass(frozen=True)
class Section:
    """One table: title, head, rows of text, and a note below."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""

    def markdown(self) -> str:
        """Return markdown under a bold title; the first column is left-aligned, the others right-aligned."""
        rule = ["---", *["---:"] * (len(self.columns) - 1)]
        lines = [f"| {' | '.join(row)} |" for row in (self.columns, rule, *self.rows)]
        return f"**{self.title}**\n\n" + "\n".join(lines) + "\n" + (f"\n{self.note}\n" if self.note else "")


def significant(value: float | None, digits: int = 3) -> str:
    """Write a figure with this number of significant digits and no exponent; a dash for a missing one."""
    if value is None or not math.isfinite(value):
        return "–"
    places = digits - 1 - math.floor(math.log10(abs(value))) if value else digits - 1
    return f"{round(value, places):.{max(places, 0)}f}"


def headline(measured: dict[str, Any]) -> str:
    """Return machine, commit, date and command of results as one line."""
    made_on, commit = measured["machine"], measured["commit"]
    code = f"commit {commit[:9]}{' with changes' if measured['dirty'] else ''}" if commit else "no commit"
    return f"{made_on['cpu']}, {made_on['cores']} cores · {code} · {measured['date'][:10]} · `{measured['command']}`"


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results, in the layout of their benchmark."""
    made: list[Section] = layout(measured["benchmark"]).sections(measured)
    return made


def layout(benchmark: str) -> ModuleType:
    """Return the module that tabulates a benchmark's results: <benchmark>_tables, or the benchmark itself."""
    apart = record.ROOT / "benchmarks" / f"{benchmark}_tables.py"
    return importlib.import_module(apart.stem if apart.is_file() else benchmark)


def table(measured: dict[str, Any], section: str | None = None) -> str:
    """Write results as markdown: every table, or the one named `section`. Raises KeyError if that does not exist."""
    made = {record.slug(s.title): s for s in sections(measured)}
    if section is not None and section not in made:
        raise KeyError(f"results {measured['name']!r} have no table {section!r} (it has {', '.join(made)})")
    chosen = [s for name, s in made.items() if section in (None, name)]
    return "\n".join([f"{headline(measured)}\n", *(s.markdown() for s in chosen)])


def compared(measured: Sequence[dict[str, Any]], source: str) -> str:
    """Write results of one benchmark with different settings as one table: one row each, for the runs of one source."""
    section: Section = layout(measured[0]["benchmark"]).compared(measured, source)
    made_on, commits = measured[0]["machine"], sorted({(m["commit"] or "no commit")[:9] for m in measured})
    dates = sorted({m["date"][:10] for m in measured})
    head = f"{made_on['cpu']}, {made_on['cores']} cores · commit {', '.join(commits)} · {', '.join(dates)}"
    return f"{head}\n\n{section.markdown()}"


def by_subject(folder: Path = record.RESULTS) -> dict[str, dict[str, dict[str, Any]]]:
    """Return every result of a folder by subject and heading: in the order of SUBJECTS, then by name."""
    found = [(record.read(path), path.stem) for path in sorted(folder.glob("*.json"))]
    names = [measured["name"] for measured, _ in found]
    order = [benchmark for benchmarks in SUBJECTS.values() for benchmark in benchmarks]

    def rank(pair: tuple[dict[str, Any], str]) -> tuple[int, str, bool, str]:
        benchmark = pair[0]["benchmark"]
        known = order.index(benchmark) if benchmark in order else len(order)
        return known, benchmark, pair[0]["name"] != benchmark, pair[1]

    listed: dict[str, dict[str, dict[str, Any]]] = {}
    for measured, stem in sorted(found, key=rank):
        subject = next((s for s, members in SUBJECTS.items() if measured["benchmark"] in members), "Other results")
        heading = measured["name"] if names.count(measured["name"]) == 1 else stem
        listed.setdefault(subject, {})[heading] = measured
    return listed


def everything(folder: Path = record.RESULTS) -> str:
    """Write every result of a folder: a heading by subject, then for each result a heading and its tables."""
    written = []
    for subject, listed in by_subject(folder).items():
        written.append(f"## {subject}\n")
        written += [f"### {name}\n\n{question(m['benchmark'])}\n\n{table(m)}" for name, m in listed.items()]
    return "\n" + "\n".join(written)


def contents(folder: Path = record.RESULTS) -> str:
    """Write the list of contents of `everything`: a line for each subject, with links to its results."""
    links = {
        subject: ", ".join(f"[{name}](#{name.lower()})" for name in m) for subject, m in by_subject(folder).items()
    }
    return "".join(f"- **{subject}**: {line}\n" for subject, line in links.items())


def question(benchmark: str) -> str:
    """Return the first line of a benchmark's docstring, and a link to the meaning of its figures."""
    program = f"{benchmark}.py"
    source = (record.ROOT / "benchmarks" / program).read_text(encoding="utf-8")
    asked = (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]
    return f"{asked} Figures: [{program}](../benchmarks/README.md#{program.replace('.', '')})."


def summary(folder: Path = record.RESULTS) -> str:
    """Write the summary of all results (see summary.py). Raises KeyError if it lacks a result."""
    made: str = importlib.import_module("summary").table(folder)
    return made


def verdicts(folder: Path = record.RESULTS) -> str:
    """Write the claims of the papers with verdicts (see claims_tables.py). Raises KeyError if it lacks a result."""
    made: str = importlib.import_module("claims_tables").table(folder)
    return made


WHOLE: dict[str, Callable[[Path], str]] = {
    "*": everything, "contents": contents, "summary": summary, "verdicts": verdicts,
}  # fmt: skip
"""Blocks that show more than the results of one name."""


def rewritten(text: str, folder: Path = record.RESULTS) -> tuple[str, list[str]]:
    """Return a document with every block replaced by its table, and the names of missing results.

    Blocks without results are not changed. `bench:NAME+NAME/SOURCE` compares several results.
    Raises KeyError for a table that the results do not have.
    """
    missing: list[str] = []

    def block(match: re.Match[str]) -> str:
        if match["what"] in WHOLE:
            return f"{match[1]}{WHOLE[match['what']](folder)}{match[4]}"
        name, _, section = match["what"].partition("/")
        found = {part: record.latest(part, folder) for part in name.split("+")}
        missing.extend(part for part, results in found.items() if results is None)
        known = [results for results in found.values() if results is not None]
        if len(known) < len(found):
            return match[0]
        if len(known) > 1:
            return f"{match[1]}{compared(known, section)}{match[4]}"
        measured = known[0]
        return f"{match[1]}{table(measured, section or None)}{match[4]}"

    return BLOCK.sub(block, text), missing


Check = Annotated[bool, tyro.conf.arg(help="change nothing; exit 1 if a document is out of date")]


def main(check: Check = False) -> int:
    """Rewrite the benchmark tables of README.md and docs/*.md from benchmarks/results/*.json."""
    wrong = 0
    for path in [record.ROOT / "README.md", *sorted((record.ROOT / "docs").glob("*.md"))]:
        before = path.read_text(encoding="utf-8") if path.exists() else ""
        try:
            after, missing = rewritten(before)
        except KeyError as problem:
            print(f"{path.name}: {problem.args[0]}", file=sys.stderr)
            return 2
        for name in missing:
            print(f"{path.name}: no results {name!r} yet, the block is not changed", file=sys.stderr)
        wrong += len(missing) + (after != before)
        if after != before:
            print(f"{'out of date' if check else 'rewritten'}: {path.relative_to(record.ROOT)}")
            if not check:
                path.write_text(after, encoding="utf-8")
    return int(check and wrong > 0)


if __name__ == "__main__":
    sys.exit(tyro.cli(main, config=(tyro.conf.FlagCreatePairsOff,)))
