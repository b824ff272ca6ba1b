"""Write what a run made in other programs' formats: sigmasplat export."""

from pathlib import Path
from typing import Annotated

import tyro

from sigmasplat.commands import options
from sigmasplat.commands.export_formats import ExportOptions, Format, Origin, choose, listed, refuse_unobeyed
from sigmasplat.commands.export_scene import SCENE
from sigmasplat.commands.export_splats import SPLATS
from sigmasplat.commands.options import refuse_existing


def _trajectory(origin: Origin, target: Path, _: ExportOptions) -> str:
    from sigmasplat.io import trajectory

    path = origin.run().read_trajectory()
    trajectory.write_trajectory(target, path)
    return f"{len(path):,} poses"


FORMATS = (*SPLATS, Format("trajectory", (".txt",), "the path as TUM text", _trajectory), *SCENE)
"""What can be written, the first by default. A new one: a row here, or a module of rows beside `export_splats`."""


DEFAULT_RUN_OPTIONS = ExportOptions()
AskedFlat = Annotated[ExportOptions, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]


def export(
    run: options.RunOrMap,
    out: options.OutFile = None,
    format: options.Format = None,
    overwrite: options.Overwrite = False,
    asked: AskedFlat = DEFAULT_RUN_OPTIONS,
) -> int:
    """Write a run's map, or a map from a file, for viewers and other programs; or a run's path.

    {formats}

    example: sigmasplat export runs/kitchen-sigma --out kitchen.spz --sigma-below 0.02
    """
    origin = Origin(run)
    chosen = choose(FORMATS, format, out)
    refuse_unobeyed(chosen, FORMATS, asked)
    target = out or Path(origin.name + chosen.endings[0])
    refuse_existing(target, overwrite)
    print(f"{target}: {chosen.write(origin, target, asked)}{_size(target)}")
    return 0


def _size(target: Path) -> str:
    return f", {target.stat().st_size / 1e6:.1f} MB" if target.is_file() else ""


export.__doc__ = (export.__doc__ or "").format(formats="\n    ".join(listed(FORMATS)))
