"""Run SLAM on a sequence, a camera or the synthetic room: sigmasplat demo | run | resume.

The order of a run: open the source, start the viewer, create the run folder, run the session (`run/session.py`), score.
"""

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.commands import options
from sigmasplat.commands.evaluate import score
from sigmasplat.commands.input_options import DEFAULT_INPUT_OPTIONS, InputOptions, InputOptionsFlat
from sigmasplat.commands.options import configured, prepare_torch, source_of
from sigmasplat.commands.view import keep_showing, serve_viewer
from sigmasplat.config.find_preset import default_preset
from sigmasplat.config.text import full_path, split_settings
from sigmasplat.errors import ConfigError

if TYPE_CHECKING:
    from sigmasplat.config import Config
    from sigmasplat.input.source import Source
    from sigmasplat.plugins.checks.motion import MotionWatch
    from sigmasplat.plugins.robots.bag import LiveRobot
    from sigmasplat.plugins.viewer.app import ViewerApp
    from sigmasplat.run.callbacks import Callback
    from sigmasplat.run.finished_map import FinishedMap
    from sigmasplat.run.resume import StartPoint
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import RunFolder
    from sigmasplat.system.slam import Slam

OK, INTERRUPTED = 0, 130
DEFAULT_PRESET = default_preset()
DEMO_FOLDER, DEMO_FRAMES = Path("runs/demo"), 120
CONTRADICTED_MOST = 0.05
"""Poses are reported if the images contradict, or cannot confirm, a larger share of them."""


def demo(
    frames: options.Frames = DEMO_FRAMES, preset: options.PresetName = DEFAULT_PRESET,
    settings: options.Settings = (), out: options.DemoFolder = DEMO_FOLDER, seed: options.Seed = None,
) -> int:  # fmt: skip
    """Run SLAM on a synthetic room and score it against the exact truth; replaces the last demo.

    example: sigmasplat demo --frames 40
    """
    whole_walk = max(frames, DEMO_FRAMES)  # a short demo is the start of this walk, at the same pace
    limit = InputOptions(limit=frames)
    return run(f"synthetic:frames={whole_walk}", preset, settings, out, overwrite=True, input_options=limit, seed=seed)


def run(
    path: options.SourcePath, preset: options.PresetName = DEFAULT_PRESET, settings: options.Settings = (),
    out: options.OutFolder = None, overwrite: options.Overwrite = False,
    input_options: InputOptionsFlat = DEFAULT_INPUT_OPTIONS, seed: options.Seed = None,
    record: options.Record = None, run_options: options.RunOptionsFlat = options.DEFAULT_RUN_OPTIONS,
    onto: options.OntoRun = None, final_seconds: options.FinalSeconds = None, realtime: options.RealTime = False,
) -> int:  # fmt: skip
    """Run SLAM on a sequence, or on a camera until Ctrl-C: trajectory, map, uncertainty, report.

    example: sigmasplat run data/kitchen --limit 200 --set input.width=480

    for robots: sigmasplat run data/kitchen --bag kitchen-bag

    with plug-ins of yours: sigmasplat run data/kitchen --plugin my.py --set input.filters=my-mask
    """
    from sigmasplat.run.finished_map import FinishedMap, continue_map
    from sigmasplat.run.resume import StartPoint
    from sigmasplat.run.session import new_run
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import RunFolder
    from sigmasplat.system.slam import Slam

    _check_robot_output(run_options.bag)
    settings += () if final_seconds is None else (f"final.seconds={final_seconds:g}",)
    screen, earlier = Screen(), FinishedMap.of(RunFolder.open(onto)) if onto else None
    config = configured(preset, settings, seed, input_options, earlier.config if earlier else None)
    if earlier:
        earlier.refuse_other_size(config)
    source, config = _opened(screen, path, config, record, split_settings(settings), earlier)
    with (
        _viewer(screen, run_options) as viewer,
        new_run(out, config, source, overwrite, onto, screen.warn, source_path=full_path(path)) as folder,
    ):
        _announce(screen, config.name, source, folder, record)
        prepare_torch()
        slam = (
            continue_map(earlier, config, source, folder) if earlier else Slam(config, folder.submaps.in_background())
        )
        _look(screen, source)
        at_once = realtime or (source.live and config.realtime.live)
        return _run_and_score(screen, StartPoint(slam), source, folder, run_options, viewer, at_once)


def resume(
    run: options.RunPath, moved_to: options.MovedSource = None,
    run_options: options.RunOptionsFlat = options.DEFAULT_RUN_OPTIONS,
) -> int:  # fmt: skip
    """Resume a run that was stopped or killed, from its last saved state.

    The result has the same bytes as an uninterrupted run.

    example: sigmasplat resume runs/kitchen-sigma
    """
    from sigmasplat.run.resume import resume as resumed
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import RunFolder

    _check_robot_output(run_options.bag)
    screen, folder = Screen(), RunFolder.open(run)
    source = source_of(folder, moved_to)
    prepare_torch()
    with _viewer(screen, run_options) as viewer, folder.locked(screen.warn):
        start = resumed(folder, source)
        folder.note(status="running")
        screen.say(f"{source.name}: {resume_line(start.next_index, len(source))} → {folder.path}")
        return _run_and_score(screen, start, source, folder, run_options, viewer)


def resume_line(next_index: int, frames: int) -> str:
    """Return the text that says where a run resumes."""
    if next_index >= frames:
        return f"all {frames} frames are done: making the final map"
    return f"resuming at frame {next_index} of {frames}"


def _opened(
    screen: "Screen", path: str, config: "Config", record: Path | None, given: Mapping[str, str],
    earlier: "FinishedMap | None",
) -> tuple["Source", "Config"]:  # fmt: skip
    """Open the source, with warnings; return it with the settings for its scene, or for the earlier map."""
    from sigmasplat.graph.closer import NETVLAD, lacks_netvlad
    from sigmasplat.plugins.sources.live import LiveSource, recording_settings
    from sigmasplat.run.scene import open_scene

    asked = config
    source, config = open_scene(path, asked, given)
    if earlier:
        scales = {name: getattr(config.input, name) for name in ("poses_scale", "predicted_scale")}
        config = earlier.config_for(source, asked.changed(input=scales), given)
    elif source.scene_scale != 1.0:
        screen.say(f"{source.name}: settings in metres are multiplied by {source.scene_scale:g}, the scene's scale")
    if isinstance(source, LiveSource):
        config = replace(config, input=recording_settings(config.input))
        if record:
            source.record_to(record)
    elif record:
        raise ConfigError("--record is for a live camera only; this sequence is already a recording")
    if config.input.poses:
        _say_of_scale(screen, asked, source, config)
    if source.registrable and not source.depth_registered:
        screen.warn("depth and colour come from different cameras; --register-depth on aligns them (see inspect)")
    if lacks_netvlad(config):
        screen.warn(f"no NetVLAD weights, so the built-in descriptor is used; {NETVLAD}")
    return source, config


def _look(screen: "Screen", source: "Source") -> None:
    """Print what is assumed, and what the first frames of a recording show, with warnings."""
    from sigmasplat.plugins.checks.motion import time_warnings, times_of
    from sigmasplat.plugins.checks.recording import first_look

    screen.assumptions(source.assumptions, source.corrections)
    if source.live:
        return
    found, warnings = first_look(source)
    if found:
        screen.say(f"{source.name}: {found}")
    for warning in (*warnings, *time_warnings(times_of(source))):
        screen.warn(warning)


def _say_of_scale(screen: "Screen", asked: "Config", source: "Source", config: "Config") -> None:
    """Print the measured unit of given poses, or that of predicted depth in theirs, or a warning if poses do not seem
    to be in metres."""
    from sigmasplat.run.scene import scale_warning

    poses, factor = config.input.poses, config.input.poses_scale
    if not asked.input.poses_scale:
        unit = "to have the scale of the predicted depth" if source.predicted_depth else "to be in metres"
        screen.say(f"{poses}: poses are multiplied by {factor:.4g} {unit}")
    elif config.input.poses_scale_depth and not asked.input.predicted_scale:
        screen.say(f"{poses}: predicted depth is multiplied by {config.input.predicted_scale:.4g} to have their scale")
    elif warning := scale_warning(source, config):
        screen.warn(warning)


def _viewer(screen: "Screen", run_options: options.RunOptions) -> AbstractContextManager["ViewerApp | None"]:
    """Start the viewer if it is requested. Raises as `serve_viewer`."""
    return serve_viewer(screen, run_options.host, run_options.port) if run_options.view else nullcontext()


def _announce(screen: "Screen", preset: str, source: "Source", folder: "RunFolder", record: Path | None) -> None:
    """Print what runs and where; record a live camera to `record` or into the run folder, to be read again later."""
    from sigmasplat.plugins.sources.live import LiveSource
    from sigmasplat.run.session import unused_path

    if not isinstance(source, LiveSource):
        screen.say(f"{source.name}: {len(source)} frames, {preset} → {folder.path}")
        return
    recording = record or unused_path(folder.path / "recording")
    if not record:
        source.record_to(recording)
    folder.note(source_path=str(recording.resolve()))
    screen.say(f"{source.name}: until Ctrl-C, {preset} → {folder.path}, recorded to {recording}")


def _run_and_score(
    screen: "Screen", start: "StartPoint", source: "Source", folder: "RunFolder", run_options: options.RunOptions,
    viewer: "ViewerApp | None", realtime: bool = False,
) -> int:  # fmt: skip
    """Run the session, then score it, and keep showing it in the viewer until Ctrl-C; return the exit code.

    realtime: track frames when they arrive. Raises KeyboardInterrupt if Ctrl-C came before the first frame was done.
    """
    from sigmasplat.plugins.checks.motion import MotionWatch
    from sigmasplat.plugins.sources.live import Arrivals, LiveSource
    from sigmasplat.realtime.system import RealTime
    from sigmasplat.render.backend import why_of
    from sigmasplat.run.resume import StateFile
    from sigmasplat.run.session import Session

    if why := why_of(start.slam.config.backend):
        screen.say(why)
    state = StateFile(start.slam, folder, run_options.save_every)
    read = Arrivals(source) if realtime else source
    system = RealTime(start.slam, covariances=False, should_stop=read.hurries) if isinstance(read, Arrivals) else None
    if system:
        state.run_save = system.save
        folder.note(realtime=True)
    motion = MotionWatch(screen.warn)
    with (
        _robot_output(screen, start.slam, folder, run_options) as robot,
        screen.steps(None if source.live else len(source), start.next_index) as steps,
    ):
        session = Session(
            system or start.slam, read, folder, [steps], state, start.next_index,
            start.wall_s, _readers(start, source, viewer, robot),
        )  # fmt: skip
        session.watch = robot.watch if robot else motion if not (system or source.live) else None
        session.later = system.between_frames if system else session.later
        outcome = session.execute()
    stopped = outcome.status == "interrupted"
    if stopped and not outcome.frames:
        raise KeyboardInterrupt  # the folder has no results, and no state to resume from
    warn_at_the_end(screen, source, read, folder, motion)
    if stopped:
        kept = f"interrupted after {outcome.summary()}; the trajectory, map and checkpoint so far are in {folder.path}"
        screen.next_commands([f"sigmasplat resume {folder.path}"], kept)
        return INTERRUPTED
    if isinstance(source, LiveSource):
        source = source_of(folder, None)  # the steps below read the recording
    if run_options.evaluate:
        score(screen, folder, source)
    else:
        from sigmasplat.plugins.evaluation.failure import failure

        kept, failed = f"{outcome.summary()}: {folder.path}", failure(folder, source)
        screen.next_commands([f"sigmasplat eval {folder.path}"], kept, failed)
    if viewer:
        keep_showing(screen, viewer, folder)
    return OK


def _check_robot_output(bag: Path | None) -> None:
    """Raise RunError before anything else starts if the bag exists or its folder cannot be written, SourceError if the
    package is missing."""
    if bag is not None:
        from sigmasplat.plugins.robots.bag import BagSink

        BagSink(bag)


@contextmanager
def _robot_output(
    screen: "Screen", slam: "Slam", folder: "RunFolder", run_options: options.RunOptions
) -> Iterator["LiveRobot | None"]:
    """Yield the callback that feeds the bag, None if it is not requested; at the end complete it and note in run.json
    how many messages were written."""
    if run_options.bag is None:
        yield None
        return
    from sigmasplat.plugins.robots.bag import LiveRobot

    robot = LiveRobot(slam, run_options.bag, screen.warn, run_options.bag_images)
    try:
        yield robot
    finally:
        robot.close()
        folder.note(bag={"written": robot.written, "failure": robot.failure})


def _readers(
    start: "StartPoint", source: "Source", viewer: "ViewerApp | None", robot: "LiveRobot | None"
) -> list["Callback"]:  # fmt: skip
    """Return what reads the system while it runs: the bag and the viewer, if they are asked for."""
    readers: list[Callback] = [robot] if robot else []
    if viewer is not None:
        from sigmasplat.plugins.viewer.snapshot_sources import LiveView

        readers.append(LiveView(start.slam, viewer.show, source.name))
    return readers


def warn_at_the_end(
    screen: "Screen", source: "Source", read: "Source", folder: "RunFolder", motion: "MotionWatch"
) -> None:
    """Print what was wrong with the frames, and whether the scale of the result is arbitrary.

    source: the sequence; read: the one that was read from, in real time the arrivals of the other one.
    """
    from sigmasplat.data.trajectory import TRACKED
    from sigmasplat.plugins.sources.live import LiveSource

    if source.skipped:
        images = "image" if len(source.skipped) == 1 else "images"
        screen.warn(f"{len(source.skipped)} {images} skipped (first: {source.skipped[0]})")
    if isinstance(source, LiveSource):
        if source.ending:
            screen.warn(source.ending)
        if source.dropped:
            screen.say(f"{source.dropped} frames of the camera were dropped because SLAM was slower")
    if read.arrived_s is not None and read.dropped:
        screen.warn(f"{read.dropped} frames were dropped because tracking was late")
    onto, chosen = folder.facts().get("onto"), folder.config().input
    if onto and not len(folder.read_trajectory()):
        apart = folder.path / "components"
        screen.warn(f"the recording was never recognised in the map of {onto['run']}; its path and map are in {apart}")
    for warning in motion.warnings():
        screen.warn(warning)
    frames = folder.read_log()
    wrong = [frame["index"] for frame in frames if frame["state"] == TRACKED and (frame.get("p_off") or 0.0) > 0.5]
    if len(wrong) > CONTRADICTED_MOST * len(frames):
        contradicted = (
            f"the images contradict the given pose in {len(wrong)} of {len(frames)} frames (p_off above 0.5); are they "
            "poses of the colour camera, camera to world, x right, y down, z forward?"
        )
        unconfirmed = (
            f"the images do not confirm the path in {len(wrong)} of {len(frames)} frames (p_off above 0.5), first in "
            f"frame {wrong[0]}: what they show is too bare, or looks the same from several places; show more around "
            "it, or return to what was seen before"
        )
        screen.warn(contradicted if chosen.poses else unconfirmed)
    if source.path_by and not chosen.poses:
        screen.say(f"the recording has poses of {source.path_by}; a run with --poses recorded uses them")
    if source.predicted_depth and not chosen.poses_scale_depth:
        screen.say("the scale is arbitrary, because a network predicted depth: lengths are not in metres")
