"""Options of run and resume that write a bag: --bag DIR, --bag-images."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from sigmasplat.commands.input_options import arg

if TYPE_CHECKING:
    from sigmasplat.plugins.robots.bag import Images, LiveRobot
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import RunFolder
    from sigmasplat.system.slam import Slam

Bag = Annotated[
    Path | None, arg("DIR", "also write a ROS 2 bag (MCAP): transforms, odometry, images; needs no ROS", "")
]


BagImages = Annotated[Literal["none", "keyframes", "all"], arg(None, "which images the bag contains, uncompressed")]


def check_robot_output(bag: Path | None) -> None:
    """Raise RunError before anything else starts if the bag exists or its folder cannot be written, SourceError if the
    package is missing."""
    if bag is not None:
        from sigmasplat.plugins.robots.bag import BagSink

        BagSink(bag)


@contextmanager
def robot_output(
    screen: "Screen", slam: "Slam", folder: "RunFolder", bag: Path | None, images: "Images"
) -> Iterator["LiveRobot | None"]:
    """Yield the callback that feeds the bag, None if it is not requested; at the end complete it and note in run.json
    how many messages were written."""
    if bag is None:
        yield None
        return
    from sigmasplat.plugins.robots.bag import LiveRobot

    robot = LiveRobot(slam, bag, screen.warn, images)
    try:
        yield robot
    finally:
        robot.close()
        folder.note(bag={"written": robot.written, "failure": robot.failure})
