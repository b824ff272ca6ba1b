"""Define the options of `sigmasplat export`."""

from typing import Annotated, Literal

import tyro

from sigmasplat.commands.option_ranges import From0, Whole
from sigmasplat.config.ranges import Range

arg = tyro.conf.arg

FormatName = Annotated[
    str | None,
    arg(metavar="NAME", help="format to write", help_behavior_hint="(default: by the ending of FILE, else ply)"),
]
SigmaBelow = Annotated[
    From0,
    arg(
        metavar="S",
        help="keep only splats with σ below S, for colours 0 to 1; σ is learned, not calibrated",
        help_behavior_hint="(default: all)",
    ),
]
StdBelowM = Annotated[
    From0,
    arg(
        metavar="M",
        help="keep only splats whose surface has a standard deviation of depth below M metres (depth_std_m, "
        "docs/exports.md); needs a run with uncertainty.json",
        help_behavior_hint="(default: all)",
    ),
]
OpacityAbove = Annotated[
    From0,
    arg(metavar="A", help="keep only splats with opacity above A", help_behavior_hint="(default: all)"),
]
Plain = Annotated[
    bool,
    arg(
        help="write PLY with only the 62 columns of 3DGS, without σ², for readers that accept no others",
        help_behavior_hint="",
    ),
]
Pictures = Annotated[
    bool, arg(help="also write the images of the keyframes, and export only keyframes as views", help_behavior_hint="")
]
MaxSplats = Annotated[
    Whole,
    Range(1),
    arg(
        metavar="N",
        help="keep at most N splats, those that fill the most pixels of the run's views",
        help_behavior_hint="(default: all)",
    ),
]
MapAxes = Annotated[
    Literal["y-up", "z-up", "y-down", "camera"] | None,
    arg(
        metavar="{y-up,z-up,y-down,camera}",
        help="axes of a map or of points: y-up, z-up and y-down are levelled; camera: those of the run's path; y-up "
        "and camera only for SPZ, glTF and OpenUSD",
        help_behavior_hint="(default: y-up for points, SPZ, glTF and OpenUSD, else y-down)",
    ),
]
SpzVersion = Annotated[
    Whole,
    Range(2, 4),
    arg(metavar="{2,3,4}", help="version of SPZ", help_behavior_hint="(default: 3, which most viewers read)"),
]
