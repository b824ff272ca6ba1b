"""Write a run or a map in other programs' formats: sigmasplat export."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sigmasplat.commands import options, picture_options
from sigmasplat.commands.options import prepare_torch, refuse_existing, source_of
from sigmasplat.config.ranges import Range
from sigmasplat.exports.formats import FORMATS, ExportSource, choose, listed, refuse_unused
from sigmasplat.io.lock import output_locked

MaxSplats = Annotated[
    options.Whole,
    Range(1),
    tyro.conf.arg(
        metavar="N",
        help="keep at most N splats, those that fill the most pixels of the run's views",
        help_behavior_hint="(default: all)",
    ),
]
MapAxes = Annotated[
    Literal["y-up", "z-up", "y-down", "camera"] | None,
    tyro.conf.arg(
        metavar="{y-up,z-up,y-down,camera}",
        help="axes of a map or of points: y-up, z-up and y-down are levelled; camera: those of the run's path; y-up "
        "and camera only for SPZ, glTF and OpenUSD",
        help_behavior_hint="(default: y-up for points, SPZ, glTF and OpenUSD, else y-down)",
    ),
]
SpzVersion = Annotated[
    options.Whole,
    Range(2, 4),
    tyro.conf.arg(metavar="{2,3,4}", help="version of SPZ", help_behavior_hint="(default: 3, which most viewers read)"),
]


@dataclass(frozen=True)
class ExportOptions:
    """Options that only some formats accept, under their names on the command line (`ExportFormat.options`)."""

    sigma_below: options.SigmaBelow = None
    std_below_m: options.StdBelowM = None
    opacity_above: options.OpacityAbove = None
    max_splats: MaxSplats = None
    axes: MapAxes = None
    spz_version: SpzVersion = None
    plain: options.Plain = False
    pictures: options.Pictures = False
    voxel_m: options.VoxelM = None
    size: picture_options.FilmSize = 0
    fps: picture_options.FilmRate = 25.0
    seconds: picture_options.FilmSeconds = None
    path: picture_options.FilmPath = "run"
    panels: picture_options.FilmPanels = "all"
    cell_m: picture_options.CellM = 0.05
    source: options.MovedSource = None

    def given(self) -> list[str]:
        """Return the names of the options that differ from their defaults."""
        return [option.name for option in fields(self) if getattr(self, option.name) != option.default]


DEFAULT_EXPORT_OPTIONS = ExportOptions()
ExportOptionsFlat = Annotated[ExportOptions, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]


def export(
    run: options.RunOrMap,
    out: options.OutFile = None,
    format: options.FormatName = None,
    overwrite: options.Overwrite = False,
    asked: ExportOptionsFlat = DEFAULT_EXPORT_OPTIONS,
) -> int:
    """Write the map or the path of a run, or a map from a file, in a format of other programs.

    {formats}

    example: sigmasplat export runs/kitchen-sigma --out kitchen.spz --sigma-below 0.02
    """
    chosen = choose(FORMATS, format, out)
    refuse_unused(chosen, FORMATS, asked.given())
    source = ExportSource(run, lambda folder: source_of(folder, asked.source))
    target = out or Path(source.name + chosen.endings[0])
    refuse_existing(target, overwrite)
    prepare_torch()
    with output_locked(target):
        refuse_existing(target, overwrite)  # another process may have written it meanwhile
        content = chosen.write(source, target, **{name: getattr(asked, name) for name in chosen.options})
    print(f"{target}: {content}{_size(target)}")
    return 0


def _size(target: Path) -> str:
    return f", {target.stat().st_size / 1e6:.1f} MB" if target.is_file() else ""


export.__doc__ = (export.__doc__ or "").format(formats="\n    ".join(listed(FORMATS)))
