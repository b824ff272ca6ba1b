"""Run SLAM on a sequence, or on the built-in room: sigmasplat demo | run | resume."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.commands import options
from sigmasplat.commands.evaluate import score
from sigmasplat.commands.options import absolute, configured, prepare_torch, source_of
from sigmasplat.errors import ConfigError
from sigmasplat.presets import default_preset

if TYPE_CHECKING:
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.screen import Screen
    from sigmasplat.snapshots import Begun
    from sigmasplat.sources.base import Source
    from sigmasplat.sources.live import LiveSource

OK, INTERRUPTED = 0, 130
DEFAULT_PRESET = default_preset()
SAVE_EVERY_S = 60.0
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
    taken = options.Taken(limit=frames)
    return run(f"synthetic:frames={whole_walk}", preset, settings, out, overwrite=True, taken=taken, seed=seed)


def run(
    path: options.SourcePath,
    preset: options.PresetName = DEFAULT_PRESET,
    settings: options.Settings = (),
    out: options.OutFolder = None,
    overwrite: options.Overwrite = False,
    taken: options.TakenFlat = options.AS_RECORDED,
    seed: options.Seed = None,
    evaluate: options.Evaluate = True,
    profile: options.Profile = False,
    save_every: options.SaveEvery = SAVE_EVERY_S,
    record: options.Record = None,
) -> int:
    """Run SLAM on a sequence, or on a camera until Ctrl-C: trajectory, map, uncertainty, report.

    example: sigmasplat run data/kitchen --limit 200 --set input.width=480
    """
    from sigmasplat.screen import Screen
    from sigmasplat.session import free, new_folder
    from sigmasplat.slam.slam import Slam
    from sigmasplat.snapshots import Begun
    from sigmasplat.sources import open_source
    from sigmasplat.sources.depth_check import depth_warning
    from sigmasplat.sources.live import LiveSource, as_recorded

    screen, config = Screen(), configured(preset, settings, seed, taken)
    source = open_source(path, config.input)
    if isinstance(source, LiveSource):
        config = replace(config, input=as_recorded(config.input))
        if record:
            source.record_to(record)
    elif record:
        raise ConfigError("--record is for a live camera; the sequence is recorded already")
    elif warning := depth_warning(source):
        screen.warn(warning)
    folder = new_folder(out, config, source, overwrite, source_path=absolute(path))
    if isinstance(source, LiveSource):
        place = record or free(folder.path / "recording")
        if not record:
            source.record_to(place)
        folder.note(source_path=str(place.resolve()))
        screen.say(f"{source.name}: until Ctrl-C, {config.name} → {folder.path}, recorded to {place}")
    else:
        screen.say(f"{source.name}: {len(source)} frames, {config.name} → {folder.path}")
    prepare_torch()
    return _record(screen, Begun(Slam(config, folder.submaps)), source, folder, evaluate, profile, save_every)


def resume(
    run: options.RunPath,
    evaluate: options.Evaluate = True,
    profile: options.Profile = False,
    save_every: options.SaveEvery = SAVE_EVERY_S,
    moved_to: options.MovedSource = None,
) -> int:
    """Go on with a run that was stopped or killed, where its state was last kept.

    The result is the same, byte for byte, as if it had not been stopped. example: sigmasplat resume runs/kitchen-sigma
    """
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.screen import Screen
    from sigmasplat.snapshots import resume as resumed

    screen, folder = Screen(), RunFolder.open(run)
    source = source_of(folder, moved_to)
    prepare_torch()
    begun = resumed(folder, source)
    folder.note(status="running")
    screen.say(f"{source.name}: going on at frame {begun.next_index} of {len(source)} → {folder.path}")
    return _record(screen, begun, source, folder, evaluate, profile, save_every)


def _record(
    screen: "Screen",
    begun: "Begun",
    source: "Source",
    folder: "RunFolder",
    evaluate: bool,
    profile: bool,
    save_every_s: float,
) -> int:
    """Run SLAM into the folder, then score it; return the exit code."""
    from sigmasplat.session import record
    from sigmasplat.snapshots import Snapshots
    from sigmasplat.sources.live import LiveSource

    keeper = Snapshots(begun.slam, folder, save_every_s)
    with screen.steps(None if source.live else len(source), begun.next_index) as watch:
        outcome = record(begun.slam, source, folder, watch, keeper, begun.next_index, begun.wall_s)
    if profile:
        screen.profile(folder.read_profile())
    if source.skipped:
        images = "image" if len(source.skipped) == 1 else "images"
        screen.warn(f"{len(source.skipped)} unreadable {images} passed over (first: {source.skipped[0]})")
    if outcome.status == "interrupted":
        screen.say(
            f"interrupted after {outcome.counts()}; trajectory, map and checkpoint so far are in {folder.path}, "
            f"`sigmasplat resume {folder.path}` goes on"
        )
        return INTERRUPTED
    if isinstance(source, LiveSource):
        _tell_ending(screen, source)
        source = source_of(folder, None)
    if evaluate:
        score(screen, folder, source)
    else:
        screen.say(f"{outcome.counts()}: {folder.path}")
    return OK


def _tell_ending(screen: "Screen", source: "LiveSource") -> None:
    """Say why the camera ended, and what was left out because SLAM was slower."""
    if source.ending:
        screen.warn(source.ending)
    if source.dropped:
        screen.say(f"{source.dropped} frames of the camera were left out while SLAM was busy")
