"""Define the options of the commands that make many runs: batch and bench table."""

from pathlib import Path
from typing import Annotated

import tyro

from sigmasplat.commands.option_ranges import From1
from sigmasplat.commands.options import arg

DataFolders = Annotated[
    tuple[str, ...],
    tyro.conf.UseAppendAction,
    arg(
        metavar="[WORKER=]ROOT",
        help="folder of the sequences; WORKER= names the worker or host of a cluster that has another one",
        help_behavior_hint="(repeatable)",
    ),
]
Jobs = Annotated[From1, arg(metavar="N", help="number of runs at the same time on this machine")]
Scheduler = Annotated[
    str | None,
    arg(
        metavar="ADDRESS",
        help="make the runs on the Dask cluster of this scheduler, for example tcp://10.0.0.1:8786",
        help_behavior_hint="(default: on this machine)",
    ),
]
BatchFolder = Annotated[
    Path | None,
    arg(metavar="DIR", help="folder of the results; finished runs in it are kept", help_behavior_hint=""),
]
ReplaceRuns = Annotated[
    bool,
    arg(name="overwrite", help="replace runs in DIR that have other settings or other code", help_behavior_hint=""),
]
Recordings = Annotated[
    tuple[str, ...],
    tyro.conf.Positional,
    arg(metavar="FOLDER", help="recordings: folders or synthetic[:frames=N,…]", help_behavior_hint="(at least one)"),
]
TableName = Annotated[
    str,
    tyro.conf.Positional,
    arg(metavar="TABLE", help="name of the table, path of a definition (.toml), or `list` to list all tables"),
]
TableScenes = Annotated[
    tuple[str, ...],
    arg(name="scenes", metavar="SCENE", help="scenes to run", help_behavior_hint="(default: all of the table)"),
]
TableSystems = Annotated[
    tuple[str, ...],
    arg(
        name="systems",
        metavar="SYSTEM",
        help="systems of the table to run, or presets",
        help_behavior_hint="(default: those of the table)",
    ),
]
