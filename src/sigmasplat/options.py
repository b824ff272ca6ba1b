"""Describe the options of the command line: type, placeholder, one line of help each."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from sigmasplat.presets import list_presets

arg = tyro.conf.arg
PresetName = Annotated[str, arg(metavar="NAME", help=f"settings to start from: {', '.join(list_presets())}")]
Settings = Annotated[
    tuple[str, ...],
    tyro.conf.UseAppendAction,
    arg(name="set", metavar="SECTION.NAME=VALUE", help="change one setting"),
]
Seed = Annotated[int | None, arg(metavar="N", help="start of all random numbers", help_behavior_hint="(default: 0)")]
RunPath = Annotated[Path, tyro.conf.Positional, arg(metavar="RUN", help="run folder")]
OutFolder = Annotated[
    Path | None,
    arg(metavar="DIR", aliases=["--output"], help="run folder", help_behavior_hint="(default: a new one in runs/)"),
]
DemoFolder = Annotated[Path, arg(metavar="DIR", aliases=["--output"], help="run folder")]
Frames = Annotated[int, arg(metavar="N", help="length of the walk through the room")]
SourcePath = Annotated[
    str, tyro.conf.Positional, arg(metavar="PATH", help="folder of a sequence, or synthetic[:frames=N]")
]
Overwrite = Annotated[bool, arg(help="replace what is there", help_behavior_hint="")]
Limit = Annotated[int | None, arg(metavar="N", help="take at most N frames", help_behavior_hint="(default: all)")]
Stride = Annotated[int, arg(metavar="N", help="take every N-th frame")]
Strict = Annotated[bool, arg(help="stop at an unreadable image, do not pass it over", help_behavior_hint="")]
Profile = Annotated[bool, arg(help="print where the time went", help_behavior_hint="")]
Evaluate = Annotated[bool, arg(name="eval", help="make no metrics and no report", help_behavior_hint="")]
MovedSource = Annotated[
    str | None,
    arg(
        name="source",
        metavar="PATH",
        help="the sequence, if it has moved",
        help_behavior_hint="(default: where it was)",
    ),
]
OutFile = Annotated[
    Path | None, arg(metavar="FILE", help="file to write", help_behavior_hint="(default: RUN's name, here)")
]
Format = Annotated[
    Literal["ply", "trajectory"] | None,
    arg(
        metavar="{ply,trajectory}",
        help="what to write",
        help_behavior_hint="(default: by the ending of FILE, else ply)",
    ),
]
