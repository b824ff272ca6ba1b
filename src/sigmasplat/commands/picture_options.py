"""Define the options of exported videos and floor plans."""

from typing import Annotated, Literal

from sigmasplat.commands.option_ranges import Number
from sigmasplat.commands.options import arg
from sigmasplat.config.ranges import Range

CellM = Annotated[float, Range(0.001, 1), arg(metavar="M", help="cell size of the floor plan in metres")]
FilmSize = Annotated[
    int,
    Range(32, 4096, or_zero=True),
    arg(
        metavar="PX",
        help="width of each panel of a video in pixels",
        help_behavior_hint="(default: that of the run's images)",
    ),
]
FilmRate = Annotated[float, Range(1, 120), arg(metavar="N", help="images per second of a video")]
FilmSeconds = Annotated[
    Number,
    Range(0.04, 3600),
    arg(
        metavar="S",
        help="length of a video in seconds",
        help_behavior_hint="(default: that of the path, 4 to 20; orbit: 12)",
    ),
]
FilmPath = Annotated[
    Literal["run", "orbit"], arg(help="camera path of a video: along the run's path, or in a circle above the room")
]
FilmPanels = Annotated[
    Literal["all", "color"], arg(help="panels of a video: colour, depth and uncertainty side by side, or colour alone")
]
