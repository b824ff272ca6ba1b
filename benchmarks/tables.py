"""Write committed results as markdown: the pages in docs/results/, and blocks in README.md and docs/*.md.

result_pages.py says what each page shows. A document holds <!-- bench:NAME --> … <!-- /bench -->, or bench:NAME/SECTION
for one table of several; `python benchmarks/tables.py` replaces the text between them. NAME is the name of results (the
newest from any machine) or a file name without .json; SECTION is the title of a table, as in path-and-speed.
bench:pages lists the pages, bench:summary is the table of summary.py, bench:verdicts and bench:held are of
claims_tables.py.
"""

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
from result_pages import PAGES, Page, Shown, link

BLOCK = re.compile(r"(<!-- bench:(?P<what>[\w./-]+) -->\n)(?P<body>.*?)(<!-- /bench -->)", re.DOTALL)
FOLDER = re.compile(r" --(?:runs|out|scratch|keep) /[^\s']*")
"""Options of a command that only name a folder of the machine on which it ran."""
ABSOLUTE = re.compile(r"(?<![\w.…/-])/[\w./-]+/([\w.-]+)")


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
    """Return machine, commit, date and command of results as one line; PATH stands for folders of that machine."""
    made_on, commit = measured["machine"], measured["commit"]
    command = ABSOLUTE.sub(r"PATH/\1", FOLDER.sub("", measured["command"]))
    code = f"commit {commit[:9]}{' with changes' if measured['dirty'] else ''}" if commit else "no commit"
    return f"{made_on['cpu']}, {made_on['cores']} cores · {code} · {measured['date'][:10]} · `{command}`"


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


def part_of(section: Section, shown: Shown) -> Section:
    """Return the columns and rows of a table that a page shows."""
    kept = [i for i, column in enumerate(section.columns) if column not in shown.without]
    chosen = [row for row in section.rows if not shown.only or {*row[:2]} & {*shown.only}]
    rows = [[row[i] for i in kept] for row in chosen if row[0] not in shown.without]
    return Section(section.title, [section.columns[i] for i in kept], rows, section.note)


def shown_on_page(shown: Shown, folder: Path) -> str:
    """Write results on a page: heading, meaning, provenance and tables. Raises KeyError for what is not there."""
    measured = record.latest(shown.name, folder)
    if measured is None:
        raise KeyError(f"a page shows the results {shown.name!r}, which are not there")
    made = [s for s in sections(measured) if not shown.tables or s.title in shown.tables]
    there = {name for s in made for name in (*s.columns, *(cell for row in s.rows for cell in row[:2]))}
    unknown = [*({*shown.tables} - {s.title for s in made}), *({*shown.without, *shown.only} - there)]
    if unknown or not made:
        raise KeyError(f"results {shown.name!r} have no {', '.join(map(repr, unknown)) or 'table'}")
    parts = [f"## {shown.name}\n", f"{shown.meaning}\n", f"{headline(measured)}\n"]
    return "\n".join([*parts, *(part_of(s, shown).markdown() for s in made)])


def page(made: Page, folder: Path = record.RESULTS) -> str:
    """Write a page of results. Raises KeyError if a result or a table is missing."""
    head = [f"# {made.title}\n", HEAD, *([f"## {made.first}\n{WHOLE[made.first](folder)}"] if made.first else ())]
    return "\n".join([*head, *(shown_on_page(shown, folder) for shown in made.shown)])


HEAD = """Written by `python benchmarks/tables.py` from `benchmarks/results/`; ± is one standard deviation over seeds.
[How to read the figures](../benchmarks.md) · [what each column means](../../benchmarks/README.md)
"""


def list_of_pages(folder: Path = record.RESULTS) -> str:
    """Write the list of the pages of results, with a link to each result."""
    lines = []
    for name, made in PAGES.items():
        results = ", ".join(link(shown.name, "results/") for shown in made.shown)
        lines.append(f"- **[{made.title}](results/{name}.md)**: {results}\n")
    return "".join(lines)


def summary(folder: Path = record.RESULTS) -> str:
    """Write the summary of all results (see summary.py). Raises KeyError if it lacks a result."""
    made: str = importlib.import_module("summary").table(folder)
    return made


def verdicts(folder: Path = record.RESULTS) -> str:
    """Write the claims of the papers with verdicts (see claims_tables.py). Raises KeyError if it lacks a result."""
    made: str = importlib.import_module("claims_tables").table(folder)
    return made


def held(folder: Path = record.RESULTS) -> str:
    """Write the lists of the claims that hold, do not, or could not be tested. Raises KeyError if it lacks a result."""
    made: str = importlib.import_module("claims_tables").lists(folder)
    return made


WHOLE: dict[str, Callable[[Path], str]] = {
    "pages": list_of_pages, "summary": summary, "verdicts": verdicts, "held": held,
}  # fmt: skip
"""Blocks that show more than the results of one name."""


def rewritten(text: str, folder: Path = record.RESULTS) -> tuple[str, list[str]]:
    """Return a document with every block replaced by its table, and the names of missing results.

    Blocks without results are not changed. Raises KeyError for a table that the results do not have.
    """
    missing: list[str] = []

    def block(match: re.Match[str]) -> str:
        if match["what"] in WHOLE:
            return f"{match[1]}{WHOLE[match['what']](folder)}{match[4]}"
        name, _, section = match["what"].partition("/")
        measured = record.latest(name, folder)
        if measured is None:
            missing.append(name)
            return match[0]
        return f"{match[1]}{table(measured, section or None)}{match[4]}"

    return BLOCK.sub(block, text), missing


def documents(root: Path = record.ROOT, folder: Path = record.RESULTS) -> tuple[dict[Path, str | None], list[str]]:
    """Return what each document should say, and the names of missing results; None for a page that should not be there.

    Raises KeyError for results or tables that a page or a block shows and that are not there.
    """
    wanted: dict[Path, str | None] = dict.fromkeys((root / "docs" / "results").glob("*.md"))
    wanted |= {root / "docs" / "results" / f"{name}.md": page(made, folder) for name, made in PAGES.items()}
    lacking = []
    for path in [root / "README.md", *sorted((root / "docs").glob("*.md"))]:
        wanted[path], missing = rewritten(path.read_text(encoding="utf-8"), folder)
        lacking += [f"{path.name}: no results {name!r} yet, the block is not changed" for name in missing]
    return wanted, lacking


Check = Annotated[bool, tyro.conf.arg(help="change nothing; exit 1 if a document is out of date")]


def main(check: Check = False) -> int:
    """Rewrite docs/results/*.md, and the tables in README.md and docs/*.md, from benchmarks/results/*.json."""
    try:
        wanted, lacking = documents()
    except KeyError as problem:
        print(f"tables.py: {problem.args[0]}", file=sys.stderr)
        return 2
    print(*lacking, sep="\n", end="\n" if lacking else "", file=sys.stderr)
    outdated = {path: text for path, text in wanted.items() if said(path) != text}
    for path, text in outdated.items():
        print(f"{'out of date' if check else 'rewritten'}: {path.relative_to(record.ROOT)}")
        if not check:
            write(path, text)
    return int(check and bool(lacking or outdated))


def said(path: Path) -> str | None:
    """Return what a document says now; None if it is not there."""
    return path.read_text(encoding="utf-8") if path.exists() else None


def write(path: Path, text: str | None) -> None:
    """Write a document, or remove it if there should be none."""
    if text is None:
        path.unlink()
        return
    path.parent.mkdir(exist_ok=True)
    path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(tyro.cli(main, config=(tyro.conf.FlagCreatePairsOff,)))
