"""Run SLAM on a sequence, or on the built-in room: sigmasplat run | demo."""

from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.commands import options
from sigmasplat.commands.evaluate import score
from sigmasplat.commands.options import absolute, configured, prepare_torch
from sigmasplat.errors import ConfigError
from sigmasplat.presets import default_preset

if TYPE_CHECKING:
    from sigmasplat.config import Config
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.screen import Screen
    from sigmasplat.sources.base import Source

OK, INTERRUPTED = 0, 130
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
) -> int:
    """Run SLAM on a sequence: trajectory, map, uncertainty, report.

    example: sigmasplat run data/kitchen --limit 200 --set input.width=480
    """
    from sigmasplat.screen import Screen
    from sigmasplat.session import new_folder
    from sigmasplat.sources import open_source
    from sigmasplat.sources.depth_check import depth_warning

    screen, config = Screen(), configured(preset, settings, seed, taken)
    source = open_source(path, config.input)
    warning = depth_warning(source)
    if warning:
        screen.warn(warning)
    folder = new_folder(out, config, source, overwrite, source_path=absolute(path))
    screen.say(f"{source.name}: {len(source)} frames, {config.name} → {folder.path}")
    return _record(screen, config, source, folder, evaluate, profile)


def _record(
    screen: "Screen", config: "Config", source: "Source", folder: "RunFolder", evaluate: bool, profile: bool
) -> int:
    """Run SLAM into the folder, then score it; return the exit code."""
    from sigmasplat.session import record
    from sigmasplat.slam.slam import Slam

    prepare_torch()
    with screen.steps(len(source)) as watch:
        outcome = record(Slam(config, folder.submaps), source, folder, watch)
    if profile:
        screen.profile(folder.read_profile())
    if source.skipped:
        images = "image" if len(source.skipped) == 1 else "images"
        screen.warn(f"{len(source.skipped)} unreadable {images} passed over (first: {source.skipped[0]})")
    if outcome.status == "interrupted":
        screen.say(f"interrupted after {outcome.counts()}; trajectory, map and checkpoint so far are in {folder.path}")
        return INTERRUPTED
    if evaluate:
        score(screen, folder, source)
    else:
        screen.say(f"{outcome.counts()}: {folder.path}")
    return OK
