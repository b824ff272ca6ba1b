"""Examine a recording before a run: sigmasplat inspect | calibrate."""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from sigmasplat.commands import options
from sigmasplat.commands.input_options import DEFAULT_INPUT_OPTIONS, InputOptionsFlat, arg
from sigmasplat.commands.options import configured, prepare_torch
from sigmasplat.config.find_preset import default_preset
from sigmasplat.config.input import sensor_numbers
from sigmasplat.config.text import split_settings
from sigmasplat.errors import ConfigError, RunError

OK, WARNED = 0, 1
SHEETS, TIMES = Path("runs/inspect"), Path("sensor_times.json")


def inspect(
    path: options.SourcePath, input_options: InputOptionsFlat = DEFAULT_INPUT_OPTIONS, settings: options.Settings = (),
    out: Annotated[Path | None, arg("FILE", "contact sheet, PNG", "(default: runs/inspect/NAME.png)")] = None,
    json: Annotated[Path | None, arg("FILE", "write what was found as JSON", "")] = None,
) -> int:  # fmt: skip
    """Check a recording before a run: format, depth, poses, and problems; draws a contact sheet.

    exit code 1 if there are warnings; example: sigmasplat inspect data/kitchen
    """
    from rich.table import Table

    from sigmasplat.files.atomic import replacing
    from sigmasplat.files.json_files import write_json
    from sigmasplat.plugins.checks.recording import inspect_source
    from sigmasplat.run.terminal import Screen

    screen = Screen()
    config = configured(default_preset(), settings, None, input_options)
    found = inspect_source(path, config.input, exposure=config.tracking.exposure)
    table = Table(title=found.title, show_header=False)
    for name, value in found.rows:
        table.add_row(name, value)
    screen.out.print(table)
    screen.assumptions(found.assumed, found.corrected)
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


def calibrate(
    path: options.SourcePath, input_options: InputOptionsFlat = DEFAULT_INPUT_OPTIONS, settings: options.Settings = (),
    out: Annotated[Path, arg("FILE", "file to write, .json, with a picture beside it, .png")] = TIMES,
) -> int:  # fmt: skip
    """Measure a camera from a recording in which it moves: when it reads depth and rows (rolling shutter), and what is
    wrong with its stated focal length, image centre, depth and brightness.

    A run with --set input.calibrate=FILE corrects its images from the first one on.

    example: sigmasplat calibrate data/kitchen --out kinect.json
    """
    from sigmasplat.data.camera_errors import sensor_said
    from sigmasplat.files.atomic import replacing
    from sigmasplat.files.json_files import write_json
    from sigmasplat.files.lock import output_locked
    from sigmasplat.plugins.outputs.drawing.sensor_times import draw_sensor_times
    from sigmasplat.run.calibrate import measure_sensor
    from sigmasplat.run.scene import open_scene
    from sigmasplat.run.terminal import Screen

    screen, out, picture = Screen(), out.with_suffix(".json"), out.with_suffix(".png")
    _refuse_others(out, picture)
    config = configured(default_preset(), settings, None, replace(input_options, poses=None))
    source, config = open_scene(path, config, split_settings(settings))
    if source.live:
        raise ConfigError("a live camera cannot be measured; record it first: sigmasplat run realsense")
    if config.tracking.fit_depth or source.computed_depth:
        raise ConfigError("predicted or stereo depth is read with its colours; calibrate a recording of a sensor")
    prepare_torch()
    with output_locked(out, screen.warn):
        with screen.counting("frames") as progress:
            found = measure_sensor(source, config, progress)
        noted = found.times.noted() | found.camera.noted()
        write_json(out, {"source": source.name, "frames": len(source)} | noted)
        with replacing(picture) as temporary:
            draw_sensor_times(found.estimate, found.costs).save(temporary, "PNG")
    screen.say(f"{sensor_said(noted)}: {out}, {picture}")
    screen.next_commands([shlex.join(["sigmasplat", "run", path, "--set", f"input.calibrate={out}"])])
    return OK


def _refuse_others(out: Path, picture: Path) -> None:
    """Raise RunError if a file of another kind would be replaced."""
    kept = next((file for file in (out, picture) if file.exists()), None)
    try:
        if kept:
            sensor_numbers(str(out))
    except ConfigError as problem:
        raise RunError(f"{kept} exists and was not written by this command; give another --out") from problem
