"""Options of run and resume that write a bag: --bag DIR, --bag-images."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sigmasplat.commands.input_options import arg

if TYPE_CHECKING:
    from sigmasplat.plugins.robots.bag import LiveRobot
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import RunFolder
    from sigmasplat.system.slam import Slam

Bag = Annotated[
    Path | None, arg("DIR", "also write a ROS 2 bag (MCAP): transforms, odometry, images; needs no ROS", "")
]


@dataclass(frozen=True)
class RobotOptions:
    """Options of run and resume: the bag."""

    bag: Bag = None
    bag_images: Annotated[
        Literal["none", "keyframes", "all"], arg(None, "which images the bag contains, uncompressed")
    ] = "keyframes"


DEFAULT_ROBOT_OPTIONS = RobotOptions()
RobotOptionsFlat = Annotated[RobotOptions, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]


def check_robot_output(asked: RobotOptions) -> None:
    """Raise RunError before anything else starts if the bag exists or its folder cannot be written, SourceError if the
    package is missing."""
    if asked.bag is not None:
        from sigmasplat.plugins.robots.bag import BagSink

        BagSink(asked.bag)


@contextmanager
def robot_output(
    screen: "Screen", slam: "Slam", folder: "RunFolder", asked: RobotOptions
) -> Iterator["LiveRobot | None"]:
    """Yield the callback that feeds the bag, None if it is not requested; at the end complete it and note in run.json
    how many messages were written."""
    if asked.bag is None:
        yield None
        return
    from sigmasplat.plugins.robots.bag import LiveRobot

    robot = LiveRobot(slam, asked.bag, screen.warn, asked.bag_images)
    try:
        yield robot
    finally:
        robot.close()
        folder.note(bag={"written": robot.written, "failure": robot.failure})
