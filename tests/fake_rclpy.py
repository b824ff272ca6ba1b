"""A simulated rclpy and message_filters: the part of their interfaces that the example uses.

The messages have the types of ROS 2 Humble as rosbags defines them. Like rclpy's, they are made without arguments, with
zeros and empty lists, and a published message must serialise to the layout of its type.
"""

import signal
import sys
from array import array
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)


def default_of(kind: Any) -> Any:
    """Return the value of a new field of a message."""
    node, what = kind
    if node.name == "BASE":
        return {"string": "", "bool": False}.get(what[0], 0.0 if what[0].startswith("float") else 0)
    if node.name == "NAME":
        return new(what)
    element, count = what
    if element[0].name == "BASE":
        return np.zeros(count if node.name == "ARRAY" else 0, element[1][0])
    return []


def new(name: str) -> Any:
    """Return a new message of a type, as geometry_msgs/msg/Pose."""
    return STORE.types[name](**{field: default_of(kind) for field, kind in STORE.fielddefs[name][1]})


def through_the_wire(message: Any) -> Any:
    """Serialise a message as ROS 2 does, and read it back."""
    kind = message.__msgtype__
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, kind), kind)


class Robot:
    """The other nodes: they send messages to topics and receive what is published."""

    def __init__(self) -> None:
        self.subscriptions: dict[str, list[Callable[[Any], object]]] = {}
        self.published: list[tuple[str, Any]] = []
        self.warnings: list[str] = []
        self.spun: Callable[[], None] = lambda: None

    def send(self, topic: str, message: Any) -> None:
        for function in self.subscriptions.get(topic, []):
            received = through_the_wire(message)
            if hasattr(received, "data"):
                received.data = array("B", received.data.tobytes())  # rclpy's type of uint8[]
            function(received)

    def install(self, patch: pytest.MonkeyPatch) -> None:
        """Make the modules importable."""
        robot = self

        class Node:
            def __init__(self, name: str) -> None:
                self.name = name

            def declare_parameter(self, name: str, value: Any) -> Any:
                return SimpleNamespace(name=name, value=value)

            def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
                def publish(message: Any) -> None:
                    assert message.__msgtype__ == kind().__msgtype__
                    robot.published.append((topic, through_the_wire(message)))

                return SimpleNamespace(publish=publish)

            def create_subscription(self, kind: Any, topic: str, function: Callable[[Any], object], qos: Any) -> None:
                robot.subscriptions.setdefault(topic, []).append(function)

            def get_logger(self) -> Any:
                return SimpleNamespace(warning=robot.warnings.append)

        class Subscriber:
            def __init__(self, node: Node, kind: Any, topic: str, qos_profile: Any = None) -> None:
                self.functions: list[Callable[[Any], object]] = []
                node.create_subscription(kind, topic, lambda message: [f(message) for f in self.functions], qos_profile)

        class ApproximateTimeSynchronizer:
            """Pairs messages whose header times differ by at most `slop` seconds."""

            def __init__(self, subscribers: list[Subscriber], queue_size: int, slop: float) -> None:
                self.queues: list[list[Any]] = [[] for _ in subscribers]
                self.size, self.slop, self.functions = queue_size, slop, list[Callable[..., object]]()
                for queue, subscriber in zip(self.queues, subscribers, strict=True):
                    subscriber.functions.append(lambda message, queue=queue: self.add(queue, message))

            def registerCallback(self, function: Callable[..., object]) -> None:
                self.functions.append(function)

            def add(self, queue: list[Any], message: Any) -> None:
                queue[:] = [*queue, message][-self.size :]
                for a in self.queues[0]:
                    for b in self.queues[1]:
                        if abs(time_s(a) - time_s(b)) <= self.slop:
                            self.queues[0].remove(a)
                            self.queues[1].remove(b)
                            for function in self.functions:
                                function(a, b)
                            return

        def spin_once(node: Node, timeout_sec: float) -> None:
            robot.spun()
            signal.raise_signal(signal.SIGINT)

        def kind(name: str) -> Callable[[], Any]:
            return lambda: new(name)

        modules = {
            "rclpy": {"init": lambda: None, "spin_once": spin_once},
            "rclpy.node": {"Node": Node},
            "rclpy.qos": {"qos_profile_sensor_data": "sensor data"},
            "message_filters": {"Subscriber": Subscriber, "ApproximateTimeSynchronizer": ApproximateTimeSynchronizer},
            "sensor_msgs": {},
            "sensor_msgs.msg": {name: kind(f"sensor_msgs/msg/{name}") for name in ("Image", "CameraInfo")},
            "nav_msgs": {},
            "nav_msgs.msg": {"Odometry": kind("nav_msgs/msg/Odometry")},
        }
        for name, values in modules.items():
            module = ModuleType(name)
            for key, value in values.items():
                setattr(module, key, value)
            patch.setitem(sys.modules, name, module)


def time_s(message: Any) -> float:
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)


def image(values: np.ndarray, encoding: str, seconds: float, frame: str, pad: int = 0, big: bool = False) -> Any:
    """Return a sensor_msgs/Image, with padded rows or big-endian numbers."""
    message, (height, width) = new("sensor_msgs/msg/Image"), values.shape[:2]
    rows = np.ascontiguousarray(values.byteswap() if big else values).reshape(height, -1).view(np.uint8)
    data = np.pad(rows, ((0, 0), (0, pad)), constant_values=7)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(seconds * 1e9), 10**9)
    message.header.frame_id, message.encoding, message.is_bigendian = frame, encoding, int(big)
    message.height, message.width, message.step, message.data = height, width, data.shape[1], data.reshape(-1)
    return message
