"""Write a run or a map in other programs' formats: sigmasplat export."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import tyro

from sigmasplat.commands import export_options, options, picture_options
from sigmasplat.commands.options import prepare_torch, refuse_existing, source_of
from sigmasplat.files.lock import output_locked
from sigmasplat.plugins.outputs.formats import ExportSource, choose, listed, refuse_unused
from sigmasplat.registry import Output, rows


@dataclass(frozen=True)
class ExportOptions:
    """Options that only some formats accept, under their names on the command line (`Output.options`)."""

    sigma_below: export_options.SigmaBelow = None
    std_below_m: export_options.StdBelowM = None
    opacity_above: export_options.OpacityAbove = None
    max_splats: export_options.MaxSplats = None
    axes: export_options.MapAxes = None
    spz_version: export_options.SpzVersion = None
    plain: export_options.Plain = False
    pictures: export_options.Pictures = False
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
    format: export_options.FormatName = None,
    overwrite: options.Overwrite = False,
    asked: ExportOptionsFlat = DEFAULT_EXPORT_OPTIONS,
) -> int:
    """Write the map or the path of a run, or a map from a file, in a format of other programs.

    {formats}

    example: sigmasplat export runs/kitchen-sigma --out kitchen.spz --sigma-below 0.02
    """
    formats = rows(Output)
    chosen = choose(formats, format, out)
    refuse_unused(chosen, formats, asked.given())
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


export.__doc__ = (export.__doc__ or "").format(formats="\n    ".join(listed(rows(Output))))
