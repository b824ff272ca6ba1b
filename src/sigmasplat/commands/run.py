"""Run SLAM on a sequence, on a camera, or on the built-in room: sigmasplat demo | run | resume."""

from dataclasses import replace
from pathlib import Path

from sigmasplat.commands import options
from sigmasplat.commands.options import configured, prepare_torch, source_of
from sigmasplat.commands.run_and_score import announce, nothing_left_of, optional_viewer, run_and_score
from sigmasplat.config.text import full_path
from sigmasplat.errors import ConfigError
from sigmasplat.presets import default_preset

DEFAULT_PRESET = default_preset()
DEMO_FOLDER, DEMO_FRAMES = Path("runs/demo"), 120


def demo(
    frames: options.Frames = DEMO_FRAMES,
    preset: options.PresetName = DEFAULT_PRESET,
    settings: options.Settings = (),
    out: options.DemoFolder = DEMO_FOLDER,
    seed: options.Seed = None,
) -> int:
    """Run SLAM on a room made in code, against exact truth; replaces the last demo.

    example: sigmasplat demo --frames 40
    """
    if frames < 1:
        raise ConfigError(f"--frames must be at least 1, found {frames}")
    whole_walk = max(frames, DEMO_FRAMES)  # fewer frames are a part of the walk: a hurried one loses the tracker
    taken = options.InputOptions(limit=frames)
    return run(f"synthetic:frames={whole_walk}", preset, settings, out, overwrite=True, taken=taken, seed=seed)


def run(
    path: options.SourcePath,
    preset: options.PresetName = DEFAULT_PRESET,
    settings: options.Settings = (),
    out: options.OutFolder = None,
    overwrite: options.Overwrite = False,
    taken: options.InputOptionsFlat = options.DEFAULT_INPUT_OPTIONS,
    seed: options.Seed = None,
    record: options.Record = None,
    ways: options.RunOptionsFlat = options.DEFAULT_RUN_OPTIONS,
) -> int:
    """Run SLAM on a sequence, or on a camera until Ctrl-C: trajectory, map, uncertainty, report.

    example: sigmasplat run data/kitchen --limit 200 --set input.width=480
    """
    from sigmasplat.run.resume import Begun
    from sigmasplat.run.session import new_folder
    from sigmasplat.run.terminal import Screen
    from sigmasplat.slam.slam import Slam
    from sigmasplat.sources import open_source
    from sigmasplat.sources.camera.depth_units import depth_warning
    from sigmasplat.sources.live import LiveSource, recording_settings

    screen, config = Screen(), configured(preset, settings, seed, taken)
    source = open_source(path, config.input)
    if isinstance(source, LiveSource):
        config = replace(config, input=recording_settings(config.input))
        if record:
            source.record_to(record)
    elif record:
        raise ConfigError("--record is for a live camera; the sequence is recorded already")
    elif warning := depth_warning(source):
        screen.warn(warning)
    if source.registrable and not source.depth_registered:
        screen.warn("depth stays in its own camera's pixels; --register-depth on moves it to colour (see inspect)")
    with optional_viewer(screen, ways) as viewer:
        folder = new_folder(out, config, source, overwrite, source_path=full_path(path))
        with nothing_left_of(folder):
            announce(screen, config.name, source, folder, record)
            prepare_torch()
            begun = Begun(Slam(config, folder.submaps))
            return run_and_score(screen, begun, source, folder, ways, viewer)


def resume(
    run: options.RunPath,
    moved_to: options.MovedSource = None,
    ways: options.RunOptionsFlat = options.DEFAULT_RUN_OPTIONS,
) -> int:
    """Go on with a run that was stopped or killed, where its state was last kept.

    The result is the same, byte for byte, as if it had not been stopped. example: sigmasplat resume runs/kitchen-sigma
    """
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.run.resume import resume as resumed
    from sigmasplat.run.terminal import Screen

    screen, folder = Screen(), RunFolder.open(run)
    source = source_of(folder, moved_to)
    prepare_torch()
    with optional_viewer(screen, ways) as viewer:
        begun = resumed(folder, source)
        folder.note(status="running")
        screen.say(f"{source.name}: {where(begun.next_index, len(source))} → {folder.path}")
        return run_and_score(screen, begun, source, folder, ways, viewer)


def where(next_index: int, frames: int) -> str:
    """Say where a run goes on."""
    if next_index >= frames:
        return f"all {frames} frames are done: making the final map again"
    return f"going on at frame {next_index} of {frames}"
