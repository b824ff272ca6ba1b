"""Define the options of `sigmasplat mesh`."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from sigmasplat.config.ranges import Range

arg = tyro.conf.arg

MeshFile = Annotated[
    Path | None,
    arg(
        metavar="FILE",
        help="file to write: .glb, .ply, .obj or .stl (no colours)",
        help_behavior_hint="(default: mesh.ply in RUN)",
    ),
]
Triangles = Annotated[int, Range(0), arg(metavar="N", help="largest number of triangles; 0 = no limit")]
FillGaps = Annotated[
    float,
    Range(0),
    arg(
        metavar="M",
        help="close gaps that are at most M metres across by smooth patches, which have a high depth_std_m; 0 = none",
    ),
]
MeshAxes = Annotated[
    Literal["y-up", "z-up", "y-down", "camera"] | None,
    arg(
        metavar="{y-up,z-up,y-down,camera}",
        help="axes of the file: y-up for viewers, z-up for CAD, y-down, or camera, those of the run's path; all but "
        "camera are levelled (docs/exports.md)",
        help_behavior_hint="(default: y-up; mesh.ply in RUN: camera)",
    ),
]
