"""Write a bag and stream while a run goes on: sigmasplat run --bag DIR --stream PORT."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sigmasplat.commands.input_options import Whole, arg
from sigmasplat.config.ranges import Range
from sigmasplat.plugins.viewer.server import is_loopback

if TYPE_CHECKING:
    from sigmasplat.plugins.robots.live import LiveRobot
    from sigmasplat.plugins.robots.outlet import Sink
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import RunFolder
    from sigmasplat.slam.slam import Slam

Bag = Annotated[
    Path | None,
    arg("DIR", "also write a ROS 2 bag (MCAP): transforms, odometry, loops, map, images; needs no ROS", ""),
]


@dataclass(frozen=True)
class RobotOptions:
    """Options of run and resume: bag and stream."""

    bag: Bag = None
    stream: Annotated[
        Whole,
        Range(0, 65535),
        arg("PORT", "also stream the same messages over a WebSocket to Foxglove, usually 8765; 0 = any free port", ""),
    ] = None
    bag_images: Annotated[
        Literal["none", "keyframes", "all"], arg(None, "which images the bag and the stream contain, uncompressed")
    ] = "keyframes"


DEFAULT_ROBOT_OPTIONS = RobotOptions()
RobotOptionsFlat = Annotated[RobotOptions, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]


def check_robot_output(asked: RobotOptions) -> None:
    """Check the options before anything else starts.

    Raises RunError if the bag exists or its folder cannot be written, SigmaSplatError if a package is missing,
    ConfigError if the port is out of range.
    """
    if asked.bag is not None:
        from sigmasplat.plugins.robots.bag import BagSink

        BagSink(asked.bag)
    if asked.stream is not None:
        from sigmasplat.plugins.robots.stream import check_stream

        check_stream(asked.stream)


@contextmanager
def robot_output(
    screen: "Screen", slam: "Slam", folder: "RunFolder", asked: RobotOptions, host: str
) -> Iterator["LiveRobot | None"]:
    """Yield the callback that feeds the bag and the stream, None if neither is requested; at the end complete both and
    note in run.json how many messages were written and dropped.

    Raises SigmaSplatError if the port is not free.
    """
    if asked.bag is None and asked.stream is None:
        yield None
        return
    from sigmasplat.plugins.robots.bag import BagSink
    from sigmasplat.plugins.robots.live import LiveRobot
    from sigmasplat.plugins.robots.outlet import Outlet
    from sigmasplat.plugins.robots.ros_messages import RosMessages
    from sigmasplat.plugins.robots.stream import StreamSink

    messages, sinks = RosMessages(), list["Sink"]()
    if asked.stream is not None:
        stream = StreamSink(messages, host, asked.stream)
        sinks.append(stream)
        if not is_loopback(host):
            screen.warn(f"anyone who can reach {host} can read the stream; omit --host to allow only "
                        "this machine")  # fmt: skip
        screen.say(f"stream: {stream.url} (Foxglove: Open connection, Foxglove WebSocket)")
    if asked.bag is not None:
        sinks.append(BagSink(asked.bag))
    outlets = [Outlet(sink, messages) for sink in sinks]
    robot = LiveRobot(slam, outlets, screen.warn, asked.bag_images)
    try:
        yield robot
    finally:
        robot.close()
        folder.note(**{outlet.sink.name: outlet.record() for outlet in outlets})
        for outlet in outlets:
            if outlet.dropped and not outlet.failure:
                screen.warn(f"the {outlet.sink.name} was too slow: {outlet.dropped} of its messages were dropped")
