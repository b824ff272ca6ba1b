"""Make the tables of papers: sigmasplat bench table. torch is loaded only when a run needs it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sigmasplat.commands import batch as batch_options, options
from sigmasplat.commands.input_options import Limit, arg
from sigmasplat.config.find_preset import default_preset
from sigmasplat.config.text import split_settings
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.plugins.presets.table_files import list_tables, read_table

if TYPE_CHECKING:
    from sigmasplat.plugins.batch.batch import Batch
    from sigmasplat.plugins.batch.definition import Cell, Table

OK, FAILED = 0, 1
LIST = "list"


@dataclass(frozen=True)
class PaperTable:
    """Which table to make, and how."""

    table: batch_options.TableName
    data: batch_options.DataFolders = ()
    scenes: batch_options.TableScenes = ()
    systems: batch_options.TableSystems = ()
    seeds: options.Runs = 3
    settings: options.Settings = ()
    limit: Limit = None
    out: batch_options.BatchFolder = None
    overwrite: batch_options.ReplaceRuns = False
    jobs: batch_options.Jobs = 1
    scheduler: batch_options.Scheduler = None
    save_every: options.SaveEvery = 60.0

    def run(self) -> int:
        """Make the missing runs, write the table after each one, print it, and return the exit code.

        Raises SigmaSplatError.
        """
        if self.table == LIST:
            print("\n".join(f"{name:20} {read_table(name)['title']}" for name in list_tables()))
            return OK
        from sigmasplat.plugins.batch.batch import Batch, open_executor
        from sigmasplat.plugins.batch.definition import Table
        from sigmasplat.run.terminal import Screen

        if not self.data:
            raise ConfigError("no --data given; give the folder that contains the scenes of the data set")
        screen = Screen()
        table = Table.read(self.table).with_systems(self.systems)
        settings = split_settings(self.settings)
        cells = table.cells(self.seeds, settings, self.limit, self.scenes)
        out = self.out or Path("runs") / table.name
        batch = Batch([cell.job for cell in cells], out / "runs")
        batch.refuse_other_runs(self.overwrite)
        executor = open_executor(self.data, self.jobs, self.scheduler, self.save_every, screen.say)
        try:
            batch.make(executor, screen, lambda: self._write(table, cells, batch, settings, out))
        except KeyboardInterrupt:
            screen.say(f"stopped; repeat the command to finish the table in {out}")
            raise
        if len(batch.missing) == len(cells):
            raise SourceError(f"no scene of {table.name} was found; --data must be the folder that contains them")
        print(self._write(table, cells, batch, settings, out), end="")
        screen.say(f"{len(batch.finished())} of {len(cells)} runs: {out / 'table.md'}")
        return FAILED if batch.failed else OK

    def _write(
        self, table: "Table", cells: "list[Cell]", batch: "Batch", settings: Mapping[str, str], out: Path
    ) -> str:
        """Write the table with the runs that are finished, and return it as Markdown."""
        from sigmasplat.plugins.batch.scores import Written

        finished = {job.name for job in batch.finished()}
        remarks = self._remarks(batch, settings, {cell.job.name: cell.scene for cell in cells}, bool(table.published))
        made = Written.of(table, cells, batch.out, finished, remarks, self._conditions(settings))
        made.save(out)
        return made.markdown()

    def _conditions(self, settings: Mapping[str, str]) -> dict[str, Any]:
        from sigmasplat.plugins.batch.job import installed_code

        return {"settings": dict(settings), "limit": self.limit, "seeds": self.seeds, "code": installed_code()}

    def _remarks(
        self, batch: "Batch", settings: Mapping[str, str], scene: Mapping[str, str], published: bool
    ) -> list[str]:
        """Return the conditions of our numbers, and what is missing, as lines below the table."""
        from sigmasplat.files.machine import package_version
        from sigmasplat.plugins.batch.job import installed_code

        seeds = f"{self.seeds} seeds, mean ± standard deviation" if self.seeds > 1 else "one seed"
        lines = [f"Ours: SigmaSplat {package_version()} (code {installed_code()}), {seeds}."]
        changed = [f"{name}={value}" for name, value in settings.items()]
        changed += [f"the first {self.limit} frames"] if self.limit else []
        if changed:
            of = "of the paper" if published else "of the table"
            lines.append(f"Not the settings {of}: {', '.join(changed)}.")
        absent = dict.fromkeys(scene[name] for name in batch.missing)
        lines += [f"Missing: {', '.join(absent)}."] if absent else []
        return lines + [f"Failed: {name}: {why}" for name, why in batch.failed.items()]


DEFAULT_PRESET = default_preset()
WIDTH = 132
"""Width of a table in characters if the output is not a terminal."""
BEST = "best value of its column"


PaperTableFlat = Annotated[PaperTable, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]
What = Annotated[Literal["table"], tyro.conf.Positional, arg("table", "what to make")]


def bench(what: What, asked: PaperTableFlat) -> int:
    """Make the table of a paper: scenes × systems × seeds, with the published numbers beside ours.

    Finished runs are kept, stopped ones resume. Missing scenes are listed, and the others are run.

    example: sigmasplat bench table list
    """
    return asked.run()
