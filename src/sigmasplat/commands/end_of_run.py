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
    """Print what was wrong with the frames, and whether the scale of the result is arbitrary.

    source: the sequence; read: the one that was read from, in real time the arrivals of the other one.
    """
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
    frames = folder.read_log() if chosen.poses else []
    wrong = sum((frame.get("p_off") or 0.0) > 0.5 for frame in frames)
    if wrong > CONTRADICTED_MOST * len(frames):
        screen.warn(
            f"the images contradict the given pose in {wrong} of {len(frames)} frames (p_off above 0.5); are they "
            "poses of the colour camera, camera to world, x right, y down, z forward?"
        )
    if source.predicted_depth and not chosen.poses_scale_depth:
        screen.say("the scale is arbitrary, because a network predicted depth: lengths are not in metres")
