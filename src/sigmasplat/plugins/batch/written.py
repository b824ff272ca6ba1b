"""Write a table as Markdown, LaTeX and JSON."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sigmasplat.files.atomic import make_folder, write_text
from sigmasplat.plugins.batch.definition import MEAN, Cell, Table
from sigmasplat.plugins.batch.scores import Row, Value, rows, run_record
from sigmasplat.run.figures import number

FILES = ("table.md", "table.tex", "table.json")
LATEX = str.maketrans(
    {
        "±": r"$\pm$", "−": r"$-$", "–": "--", "\u202f": r"\,", "%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#",
        "²": r"$^2$", "σ": r"$\sigma$", "×": r"$\times$", "↑": r"$\uparrow$", "↓": r"$\downarrow$",
    }
)  # fmt: skip


@dataclass(frozen=True)
class Written:
    """A table with the scores of its finished runs. `lines` are the remarks below it: what is missing, conditions."""

    table: Table
    cells: Sequence[Cell]
    rows: Sequence[Row]
    lines: Sequence[str]
    conditions: Mapping[str, Any]

    @staticmethod
    def of(
        table: Table, cells: Sequence[Cell], folder: Path, finished: set[str], remarks: Sequence[str],
        conditions: Mapping[str, Any],
    ) -> "Written":  # fmt: skip
        """Read the scores of the finished runs, given by the names of their jobs."""
        records = {cell.job.name: run_record(folder / cell.job.name) for cell in cells if cell.job.name in finished}
        lines = [*remarks, *table.notes, *_sources(table)]
        return Written(table, cells, rows(table, cells, records), lines, conditions)

    def save(self, folder: Path) -> None:
        """Write table.md, table.tex and table.json. Raises RunError if they cannot be written."""
        make_folder(folder)
        texts = self.markdown(), self.latex(), json.dumps(self.values(), indent=1, ensure_ascii=False) + "\n"
        for name, text in zip(FILES, texts, strict=True):
            write_text(folder / name, text)

    @property
    def columns(self) -> list[str]:
        """Return the scenes, and the mean over them if there are several."""
        return [scene.name for scene in self.table.scenes] + [MEAN] * (len(self.table.scenes) > 1)

    def cells_of(self, row: Row) -> list[str]:
        """Return a row as text: score, system, a value per column."""
        shown = (self._shown(row, row.values.get(column)) for column in self.columns)
        return [row.score.title, f"{row.system} ({row.origin})", *shown]

    def _shown(self, row: Row, value: Value | None) -> str:
        if value is None:
            return number(None, 0)
        text = number(value.mean, row.score.digits)
        text += "" if value.deviation is None else f" ± {number(value.deviation, row.score.digits)}"
        return text if value.scenes is None else f"{text} ({value.scenes} of {len(self.table.scenes)} scenes)"

    def markdown(self) -> str:
        """Return the table as Markdown."""
        head = ["score", "system", *self.columns]
        lines = [f"# {self.table.title}", "", _line(head), _line(["---", "---"] + ["---:"] * len(self.columns))]
        lines += [_line(self.cells_of(row)) for row in self.rows]
        return "\n".join([*lines, "", *(f"- {line}" for line in self.lines)]) + "\n"

    def latex(self) -> str:
        """Return the table as LaTeX; it needs the package booktabs."""
        head = ["score", "system", *self.columns]
        lines = [r"\begin{tabular}{ll" + "r" * len(self.columns) + "}", r"\toprule", _latex_line(head)]
        score = None
        for row in self.rows:
            if row.score != score:
                lines.append(r"\midrule")
            score = row.score
            lines.append(_latex_line(self.cells_of(row)))
        remarks = [f"% {line}" for line in (self.table.title, *self.lines)]
        return "\n".join([*remarks, *lines, r"\bottomrule", r"\end{tabular}"]) + "\n"

    def values(self) -> dict[str, Any]:
        """Return the table as values for JSON: the conditions, the rows and the runs."""
        return {
            "table": self.table.name,
            "title": self.table.title,
            **self.conditions,
            "remarks": list(self.lines),
            "rows": [
                {"score": row.score.name, "unit": row.score.unit, "system": row.system, "origin": row.origin}
                | {"values": {scene: asdict(value) for scene, value in row.values.items()}}
                for row in self.rows
            ],
            "runs": [
                {"scene": cell.scene, "system": cell.system, "seed": cell.seed, "folder": cell.job.name}
                for cell in self.cells
            ],
        }


def _sources(table: Table) -> list[str]:
    """Return a line per source of published numbers, with the systems whose numbers are from there."""
    systems = dict[str, list[str]]()
    for published in table.published:
        systems.setdefault(published.source, []).append(published.system)
    return [f"Published: {source} ({', '.join(names)})." for source, names in systems.items()]


def _line(words: Sequence[str]) -> str:
    return "| " + " | ".join(words) + " |"


def _latex_line(words: Sequence[str]) -> str:
    return " & ".join(word.translate(LATEX) for word in words) + r" \\"
