"""Write a run or a map in other programs' formats, or as a page for a browser: sigmasplat export, sigmasplat share."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sigmasplat.commands import options
from sigmasplat.commands.input_options import From0, Number, arg, flag
from sigmasplat.commands.options import prepare_torch, refuse_existing
from sigmasplat.config.ranges import Range
from sigmasplat.errors import ConfigError
from sigmasplat.files.lock import output_locked
from sigmasplat.plugins.outputs.formats import ExportSource, choose, listed, refuse_unused
from sigmasplat.registry import Output, rows


@dataclass(frozen=True)
class ExportOptions:
    """Options that only some formats accept, under their names on the command line (`Output.options`)."""

    std_below_m: Annotated[From0, arg(
        "M", "keep only splats whose surface has a standard deviation of depth below M metres (depth_std_m, "
        "docs/exports.md); needs a run with uncertainty.json", "(default: all)",
    )] = None  # fmt: skip
    uncertain: Annotated[bool, flag("show in a video also the splats that are uncertain")] = False
    axes: Annotated[Literal["y-up", "z-up", "y-down", "camera"] | None, arg(
        "{y-up,z-up,y-down,camera}", "axes of a map: y-up, z-up and y-down are levelled; camera: those of the run's "
        "path; SPZ: only y-up and camera", "(default: y-up for SPZ, y-down for PLY)",
    )] = None  # fmt: skip
    up: options.UpEdge = "auto"
    plain: Annotated[
        bool, flag("write PLY with only the 62 columns of 3DGS, without σ², for readers that accept no others")
    ] = False
    pictures: Annotated[
        bool, flag("also write the images of the keyframes, and export only keyframes as views")
    ] = False  # fmt: skip
    size: Annotated[
        int, Range(32, 4096, or_zero=True),
        arg("PX", "width of each panel of a video in pixels", "(default: that of the run's images)"),
    ] = 0  # fmt: skip
    fps: Annotated[float, Range(1, 120), arg("N", "images per second of a video")] = 25.0
    seconds: Annotated[
        Number, Range(0.04, 3600),
        arg("S", "length of a video in seconds", "(default: that of the path, 4 to 20; orbit: 12)"),
    ] = None  # fmt: skip
    path: Annotated[
        Literal["run", "orbit"], arg(None, "camera path of a video: along the run's path, or around the room")
    ] = "run"
    panels: Annotated[
        Literal["all", "color"],
        arg(None, "panels of a video: colour, depth and uncertainty side by side, or colour alone"),
    ] = "all"
    cell_m: Annotated[float, Range(0.001, 1), arg("M", "cell size of the floor plan in metres")] = 0.05

    def given(self) -> list[str]:
        """Return the names of the options that differ from their defaults."""
        return [option.name for option in fields(self) if getattr(self, option.name) != option.default]


DEFAULT_EXPORT_OPTIONS = ExportOptions()


def export(
    run: options.RunOrMap, out: options.OutFile = None,
    format: Annotated[str | None, arg("NAME", "format to write", "(default: by the ending of FILE, else ply)")] = None,
    overwrite: options.Overwrite = False,
    asked: Annotated[ExportOptions, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes] = DEFAULT_EXPORT_OPTIONS,
) -> int:  # fmt: skip
    """Write the map or the path of a run, or a map from a PLY, in a format of other programs.

    {formats}

    example: sigmasplat export runs/kitchen-sigma --out kitchen.spz --std-below-m 0.02
    """
    formats = rows(Output)
    chosen = choose(formats, format, out)
    refuse_unused(chosen, formats, asked.given())
    source = ExportSource(run)
    target = out or Path(source.name + chosen.endings[0])
    refuse_existing(target, overwrite)
    prepare_torch()
    with output_locked(target):
        refuse_existing(target, overwrite)  # another process may have written it meanwhile
        content = chosen.write(source, target, **{name: getattr(asked, name) for name in chosen.options})
    print(f"{target}: {content}" + (f", {target.stat().st_size / 1e6:.1f} MB" if target.is_file() else ""))
    return 0


def share(
    run: options.RunPath,
    out: Annotated[Path | None, arg("FILE.html", "page to write", "(default: named after RUN, in this folder)")] = None,
    film: Annotated[bool, flag("also write a film of ten seconds along the path, FILE.mp4")] = False,
    usdz: Annotated[bool, flag("also write a mesh for Quick Look on a phone or a Mac of Apple, FILE.usdz")] = False,
    up: options.UpEdge = "auto", overwrite: options.Overwrite = False,
) -> int:  # fmt: skip
    """Write a run as one HTML page that any browser opens, offline: walk around, measure, see what is uncertain.

    example: sigmasplat share runs/kitchen-sigma --out kitchen.html
    """
    target = out or Path(run.resolve().name + ".html")
    if target.suffix.lower() != ".html":
        raise ConfigError(f"browsers do not open {target} as a page; give --out a name that ends in .html")
    movie, mesh = target.with_suffix(".mp4"), target.with_suffix(".usdz")
    refuse_existing(movie if film else None, overwrite)
    refuse_existing(mesh if usdz else None, overwrite)
    export(run, target, "html", overwrite, ExportOptions(up=up))
    print("open it in a browser, or send it: it needs no network")
    if film:
        export(run, movie, "video", overwrite, ExportOptions(seconds=10.0, panels="color"))
    if usdz:
        from sigmasplat.commands.mesh import make_mesh

        make_mesh(run, out=mesh, up=up, overwrite=overwrite)
    return 0


export.__doc__ = (export.__doc__ or "").format(formats="\n    ".join(listed(rows(Output))))
