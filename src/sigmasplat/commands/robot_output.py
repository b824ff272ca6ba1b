"""Write a bag and stream while a run goes on: sigmasplat run --bag DIR --stream PORT."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from sigmasplat.commands import options
from sigmasplat.viewer.server import is_loopback

if TYPE_CHECKING:
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.robots.live import LiveRobot
    from sigmasplat.robots.outlet import Sink
    from sigmasplat.run.terminal import Screen
    from sigmasplat.slam.slam import Slam


def check_robot_output(run_options: options.RunOptions) -> None:
    """Check the options before anything else starts.

    Raises RunError if the bag exists or its folder cannot be written, SigmaSplatError if a package is missing,
    ConfigError if the port is out of range.
    """
    if run_options.bag is not None:
        from sigmasplat.robots.bag import BagSink

        BagSink(run_options.bag)
    if run_options.stream is not None:
        from sigmasplat.robots.stream import check_stream

        check_stream(run_options.stream)


@contextmanager
def robot_output(
    screen: "Screen", slam: "Slam", folder: "RunFolder", run_options: options.RunOptions
) -> Iterator["LiveRobot | None"]:
    """Yield the callback that feeds the bag and the stream, None if neither is requested; at the end complete both and
    note in run.json how many messages were written and dropped.

    Raises SigmaSplatError if the port is not free.
    """
    if run_options.bag is None and run_options.stream is None:
        yield None
        return
    from sigmasplat.robots.bag import BagSink
    from sigmasplat.robots.live import LiveRobot
    from sigmasplat.robots.outlet import Outlet
    from sigmasplat.robots.ros_messages import RosMessages
    from sigmasplat.robots.stream import StreamSink

    messages, sinks = RosMessages(), list["Sink"]()
    if run_options.stream is not None:
        stream = StreamSink(messages, run_options.host, run_options.stream)
        sinks.append(stream)
        if not is_loopback(run_options.host):
            screen.warn(f"anyone who can reach {run_options.host} can read the stream; omit --host to allow only "
                        "this machine")  # fmt: skip
        screen.say(f"stream: {stream.url} (Foxglove: Open connection, Foxglove WebSocket)")
    if run_options.bag is not None:
        sinks.append(BagSink(run_options.bag))
    outlets = [Outlet(sink, messages) for sink in sinks]
    robot = LiveRobot(slam, outlets, screen.warn, run_options.bag_images)
    try:
        yield robot
    finally:
        robot.close()
        folder.note(**{outlet.sink.name: outlet.record() for outlet in outlets})
        for outlet in outlets:
            if outlet.dropped and not outlet.failure:
                screen.warn(f"the {outlet.sink.name} was too slow: {outlet.dropped} of its messages were dropped")
