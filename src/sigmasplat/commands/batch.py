"""Make many runs: sigmasplat batch, of recordings, and sigmasplat bench table, of the table of a paper.

torch is loaded only when it is needed.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sigmasplat.commands import options
from sigmasplat.commands.input_options import DEFAULT_INPUT_OPTIONS, From1, InputOptionsFlat, Limit, arg, flag
from sigmasplat.config.find_preset import default_preset
from sigmasplat.config.text import full_path, split_settings
from sigmasplat.errors import ConfigError, SourceError

if TYPE_CHECKING:
    from sigmasplat.plugins.batch.batch import Batch
    from sigmasplat.run.terminal import Screen

DataFolder = Annotated[str | None, arg("ROOT", "folder that contains the recordings", "")]
Jobs = Annotated[From1, arg("N", "number of runs at the same time")]
BatchFolder = Annotated[Path | None, arg("DIR", "folder of the results; finished runs in it are kept", "")]
ReplaceRuns = Annotated[bool, flag("replace runs in DIR that have other settings or other code")]

OK, FAILED = 0, 1
DEFAULT_PRESET = default_preset()
OUT = Path("runs/batch")


def batch(
    recordings: Annotated[
        tuple[str, ...], tyro.conf.Positional,
        arg("FOLDER", "recordings: folders or synthetic[:frames=N,…]", "(at least one)"),
    ],
    preset: options.PresetName = DEFAULT_PRESET, settings: options.Settings = (), seed: options.Seed = None,
    seeds: Annotated[From1, arg("N", "number of runs of each recording, with N seeds from --seed on")] = 1,
    input_options: InputOptionsFlat = DEFAULT_INPUT_OPTIONS, data: DataFolder = None, mesh: options.WithMesh = False,
    out: BatchFolder = None, overwrite: ReplaceRuns = False, jobs: Jobs = 1, save_every: options.SaveEvery = 60.0,
) -> int:  # fmt: skip
    """Run SLAM on many recordings, each in a run folder in DIR (default: runs/batch), and score them.

    Finished runs are kept, stopped ones resume; exit code 1 if a run failed.

    example: sigmasplat batch data/kitchen data/hall --jobs 2
    """
    from sigmasplat.plugins.batch.batch import Batch
    from sigmasplat.plugins.batch.job import Job
    from sigmasplat.run.terminal import Screen

    if not recordings:
        raise ConfigError("no FOLDER given; give one or more recordings")
    config = options.configured(preset, settings, seed, input_options)
    paths = tuple(dict.fromkeys(recordings if data else map(full_path, recordings)))
    planned = [
        Job(f"{name}-seed{config.seed + k}" if k else name, (path,), replace(config, seed=config.seed + k), mesh)
        for name, path in zip(_names(paths), paths, strict=True)
        for k in range(seeds)
    ]
    screen, made = Screen(), Batch(planned, out or OUT)
    _make(screen, made, data, jobs, save_every, overwrite, lambda: None)
    if len(made.missing) == len(planned):
        raise SourceError(next(iter(made.missing.values())))
    _show(screen, made)
    return FAILED if made.failed or made.missing else OK


def bench(
    what: Annotated[Literal["table"], tyro.conf.Positional, arg("table", "always the word `table`")],
    table: Annotated[
        str, tyro.conf.Positional,
        arg("TABLE", "name of the table, path of a definition (.toml), or `list` to list all tables"),
    ],
    data: DataFolder = None,
    scenes: Annotated[tuple[str, ...], arg("SCENE", "scenes to run", "(default: all of the table)")] = (),
    systems: Annotated[
        tuple[str, ...], arg("SYSTEM", "systems of the table to run, or presets", "(default: those of the table)"),
    ] = (),
    seeds: options.Runs = 3, settings: options.Settings = (), limit: Limit = None, out: BatchFolder = None,
    overwrite: ReplaceRuns = False, jobs: Jobs = 1, save_every: options.SaveEvery = 60.0,
) -> int:  # fmt: skip
    """Make the table of a paper: scenes × systems × seeds, with the published numbers beside ours.

    Finished runs are kept, stopped ones resume. Missing scenes are listed, others run; exit code 1 if one fails.

    example: sigmasplat bench table list; then: sigmasplat bench table NAME --data data/tum
    """
    from sigmasplat.plugins.presets.table_files import list_tables, read_table

    if table == "list":
        print("\n".join(f"{name:20} {read_table(name)['title']}" for name in list_tables()))
        return OK
    from sigmasplat.plugins.batch.batch import Batch
    from sigmasplat.plugins.batch.definition import Table
    from sigmasplat.plugins.batch.scores import Written
    from sigmasplat.run.terminal import Screen

    if not data:
        raise ConfigError("no --data given; give the folder that contains the scenes of the data set")
    chosen, changes = Table.read(table).with_systems(systems), split_settings(settings)
    cells = chosen.cells(seeds, changes, limit, scenes)
    screen, folder = Screen(), out or Path("runs") / chosen.name
    made = Batch([cell.job for cell in cells], folder / "runs")

    def write() -> str:
        """Write the table with the runs that are finished, and return it as Markdown."""
        written = Written.of(chosen, cells, made, seeds, changes, limit)
        written.save(folder)
        return written.markdown()

    _make(screen, made, data, jobs, save_every, overwrite, write)
    if len(made.missing) == len(cells):
        raise SourceError(f"no scene of {chosen.name} was found; --data must be the folder that contains them")
    print(write(), end="")
    screen.say(f"{len(made.finished())} of {len(cells)} runs: {folder / 'table.md'}")
    return FAILED if made.failed else OK


def _make(
    screen: "Screen", made: "Batch", data: str | None, jobs: int, save_every_s: float, overwrite: bool,
    ended: Callable[[], object],
) -> None:  # fmt: skip
    """Make the missing runs of a batch; `ended` is called after each one."""
    from sigmasplat.plugins.batch.batch import Executor

    made.refuse_other_runs(overwrite)
    try:
        made.make(Executor(data, save_every_s, jobs), screen, ended)
    except KeyboardInterrupt:
        screen.say(f"stopped; repeat the command to make the other runs in {made.out}")
        raise


def _names(paths: Sequence[str]) -> list[str]:
    """Return a folder name for each recording: the last part of its path, numbered if several have the same."""
    names = list[str]()
    for path in paths:
        plain = "".join(c if c.isalnum() or c in "._-" else "-" for c in Path(path).name).strip("-.") or "run"
        name, number = plain, 1
        while name in names:
            number += 1
            name = f"{plain}-{number}"
        names.append(name)
    return names


def _show(screen: "Screen", made: "Batch") -> None:
    from rich.table import Table

    from sigmasplat.plugins.batch.definition import Score
    from sigmasplat.run.figures import number
    from sigmasplat.run_folder.runs import RunFolder

    shown = (
        Score("frames", ("frames",), digits=0), Score("lost", ("lost",), digits=0),
        Score("ATE RMSE, cm", ("ate.rmse_m",), factor=100.0),
        Score("PSNR, dB", ("held_out.psnr_db", "training.psnr_db")), Score("frames/s", ("frames_per_s",)),
    )  # fmt: skip
    table = Table("run", *(score.name for score in shown))
    for column in table.columns[1:]:
        column.justify = "right"
    for job in made.finished():
        metrics = RunFolder(made.out / job.name).read_metrics()
        table.add_row(job.name, *(number(score.value(metrics), score.digits) for score in shown))
    for name, why in made.failed.items():
        table.add_row(name, "failed")
        screen.say(f"{name}: {why}", "bold red")
    screen.out.print(table)
    screen.say(f"{len(made.finished())} of {len(made.jobs)} runs: {made.out}")
