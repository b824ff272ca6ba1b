"""Command `sigmasplat inspect`: check a recording before a run."""

from pathlib import Path
from typing import Annotated

from sigmasplat.commands import options
from sigmasplat.commands.input_options import DEFAULT_INPUT_OPTIONS, InputOptionsFlat, arg
from sigmasplat.commands.options import configured
from sigmasplat.config.find_preset import default_preset

OK, WARNED = 0, 1
SHEETS = Path("runs/inspect")


def inspect(
    path: options.SourcePath,
    input_options: InputOptionsFlat = DEFAULT_INPUT_OPTIONS,
    settings: options.Settings = (),
    out: Annotated[
        Path | None,
        arg("FILE", "contact sheet, PNG", "(default: runs/inspect/NAME.png)"),
    ] = None,
    json: Annotated[
        Path | None,
        arg("FILE", "write what was found as JSON", ""),
    ] = None,
) -> int:
    """Check a recording before a run: format, depth, poses, and problems; draws a contact sheet.

    exit code 1 if there are warnings; example: sigmasplat inspect data/kitchen
    """
    from rich.table import Table

    from sigmasplat.files.atomic import replacing
    from sigmasplat.files.json_files import write_json
    from sigmasplat.plugins.checks.recording import inspect_source
    from sigmasplat.run.terminal import Screen

    screen = Screen()
    found = inspect_source(path, configured(default_preset(), settings, None, input_options).input)
    table = Table(title=found.title, show_header=False)
    for name, value in found.rows:
        table.add_row(name, value)
    screen.out.print(table)
    for warning in found.warnings:
        screen.warn(warning)
    target = out or SHEETS / f"{found.title}.png"
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as temporary:
        found.sheet.save(temporary, "PNG")
    screen.say(f"contact sheet: {target}")
    if json is not None:
        write_json(json, found.record())
    return WARNED if found.warnings else OK
