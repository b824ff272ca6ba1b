"""What `run` says of the frames when the last one is done."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sigmasplat.input.source import Source
    from sigmasplat.plugins.checks.motion import MotionWatch
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import RunFolder

CONTRADICTED_MOST = 0.05
"""Given poses are reported if the images contradict a larger share of them."""


def warn_at_the_end(
    screen: "Screen", source: "Source", read: "Source", folder: "RunFolder", motion: "MotionWatch"
) -> None:
    """Print what was wrong with the frames, and whether the scale of the result is arbitrary."""
    _warn_of_skipped_frames(screen, source)
    _warn_of_dropped_frames(screen, read)
    _warn_if_never_recognised(screen, folder)
    for warning in motion.warnings():
        screen.warn(warning)
    chosen = folder.config().input
    if chosen.poses:
        _warn_of_contradicted_poses(screen, folder)
    if source.predicted_depth and not chosen.poses_scale_depth:
        screen.say("the scale is arbitrary, because a network predicted depth: lengths are not in metres")


def _warn_of_skipped_frames(screen: "Screen", source: "Source") -> None:
    """Print how many frames are missing from the run, and why."""
    from sigmasplat.plugins.sources.live import LiveSource

    if source.skipped:
        images = "image" if len(source.skipped) == 1 else "images"
        screen.warn(f"{len(source.skipped)} {images} skipped (first: {source.skipped[0]})")
    if isinstance(source, LiveSource):
        if source.ending:
            screen.warn(source.ending)
        if source.dropped:
            screen.say(f"{source.dropped} frames of the camera were dropped because SLAM was slower")


def _warn_of_dropped_frames(screen: "Screen", read: "Source") -> None:
    """Print how many frames were dropped in real time."""
    if read.arrived_s is not None and read.dropped:
        screen.warn(f"{read.dropped} frames were dropped because tracking was late")


def _warn_if_never_recognised(screen: "Screen", folder: "RunFolder") -> None:
    """Print a warning if no frame of a run with --onto is connected to the earlier map."""
    onto = folder.facts().get("onto")
    if onto and not len(folder.read_trajectory()):
        screen.warn(
            f"the recording was never recognised in the map of {onto['run']}; its path and map are in "
            f"{folder.path / 'components'}"
        )


def _warn_of_contradicted_poses(screen: "Screen", folder: "RunFolder") -> None:
    """Print a warning if many given poses are probably wrong."""
    frames = folder.read_log()
    wrong = sum((frame.get("p_off") or 0.0) > 0.5 for frame in frames)
    if wrong > CONTRADICTED_MOST * len(frames):
        screen.warn(
            f"the images contradict the given pose in {wrong} of {len(frames)} frames (p_off above 0.5); are they "
            "poses of the colour camera, camera to world, x right, y down, z forward?"
        )
