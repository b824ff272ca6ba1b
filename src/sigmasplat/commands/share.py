"""Write a run as files for people who have no SigmaSplat: sigmasplat share."""

from pathlib import Path
from typing import Annotated

from sigmasplat.commands import options
from sigmasplat.commands.export import ExportOptions, export
from sigmasplat.commands.input_options import arg, flag
from sigmasplat.commands.options import refuse_existing
from sigmasplat.errors import ConfigError


def share(
    run: options.RunPath,
    out: Annotated[Path | None, arg("FILE.html", "page to write", "(default: named after RUN, in this folder)")] = None,
    film: Annotated[bool, flag("also write a film of ten seconds along the path, FILE.mp4")] = False,
    up: options.UpEdge = "auto", overwrite: options.Overwrite = False,
) -> int:  # fmt: skip
    """Write a run as one HTML page that any browser opens, offline: walk around, measure, see what is uncertain.

    example: sigmasplat share runs/kitchen-sigma --out kitchen.html
    """
    target = out or Path(run.resolve().name + ".html")
    if target.suffix.lower() != ".html":
        raise ConfigError(f"browsers do not open {target} as a page; give --out a name that ends in .html")
    beside = target.with_suffix(".mp4")
    refuse_existing(beside if film else None, overwrite)
    export(run, target, "html", overwrite, ExportOptions(up=up))
    print("open it in a browser, or send it: it needs no network")
    if film:
        export(run, beside, "video", overwrite, ExportOptions(seconds=10.0, panels="color"))
    return 0
