"""Read topics and messages of ROS bags without ROS, through the rosbags package (Apache-2.0).

ROS 1 is one file that starts with "#ROSBAG V2.0"; ROS 2 is a folder with metadata.yaml, or one of its storage files:
MCAP (starts with 89 "MCAP0"), SQLite (.db3).
"""

import struct
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from sigmasplat.errors import SourceError
from sigmasplat.files.optional import import_optional
from sigmasplat.files.reading import open_regular, refuse_special

Message = Any
Value = TypeVar("Value")

TRANSFORMS = "tf2_msgs/msg/TFMessage"
METADATA = "metadata.yaml"
MOST_METADATA_BYTES = 1 << 20
"""Largest metadata.yaml: it has some hundred bytes for each topic and file, and 1 MB of YAML takes seconds to read."""
ROS1_MAGIC, MCAP_MAGIC, SQLITE_MAGIC = b"#ROSBAG V2.0", b"\x89MCAP0", b"SQLite format 3\0"


@dataclass(frozen=True)
class Topic:
    """A topic: name, message type (such as sensor_msgs/msg/Image) and number of messages."""

    name: str
    msgtype: str
    count: int


@dataclass(frozen=True)
class Entry:
    """Position of a message: recording time and index among messages of that time; `stamp_ns`: its header's time."""

    recorded_ns: int
    place: int
    stamp_ns: int


class Bag:
    """An open bag; only the list of topics is kept in memory. Safe to read from several threads."""

    def __init__(self, path: Path) -> None:
        """Open the bag. Raises SourceError if the rosbags package is missing, or the file is damaged."""
        self.path, self._lock = path, threading.Lock()
        for file in sorted(path.iterdir()) if path.is_dir() else [path]:
            if not file.is_dir():
                refuse_special(file, most=MOST_METADATA_BYTES if file.name == METADATA else None)
        self.ros1 = path.is_file() and _magic(path).startswith(ROS1_MAGIC)
        reader = import_optional(
            "rosbags.rosbag1" if self.ros1 else "rosbags.rosbag2", "ros", f"{path}: a ROS bag"
        ).Reader
        typesys = import_optional("rosbags.typesys", "ros", f"{path}: a ROS bag")
        # The common message types never changed; the type definitions stored in a bag are not needed and may be wrong.
        self._types = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if self.ros1 else typesys.Stores.LATEST)
        if TRANSFORMS not in self._types.fielddefs:
            fields = "geometry_msgs/TransformStamped[] transforms"
            self._types.register(typesys.get_types_from_msg(fields, TRANSFORMS))
        self._reader = self._guarded(lambda: reader(path))
        self._guarded(self._reader.open)
        weakref.finalize(self, self._reader.close)
        self.topics = {
            name: Topic(name, info.msgtype or "", info.msgcount)
            for name, info in self._guarded(lambda: self._reader.topics).items()
        }

    def topics_of_type(self, *types: str) -> list[Topic]:
        """Return the topics of these message types that have messages, sorted by name."""
        return [topic for _, topic in sorted(self.topics.items()) if topic.msgtype in types and topic.count]

    def first_message(self, name: str) -> Message:
        """Read the first message of a topic. Raises SourceError if it is damaged."""
        for message in self.messages(name):
            return message
        raise SourceError(f"{self.path}: unreadable bag (topic {name} has no message); copy it again")

    def messages(self, name: str) -> Iterator[Message]:
        """Read the messages of a topic in recording order. Raises SourceError if one is damaged."""
        return (self._decoded(name, raw) for _, _, raw in self._raw([name]))

    def index(self, *names: str) -> dict[str, list[Entry]]:
        """Return the entries of topics whose messages have headers. Raises SourceError if the bag is damaged."""
        found: dict[str, list[Entry]] = {name: [] for name in names}
        for name, recorded_ns, raw in self._raw(names):
            earlier = found[name]
            place = earlier[-1].place + 1 if earlier and earlier[-1].recorded_ns == recorded_ns else 0
            earlier.append(Entry(recorded_ns, place, self._stamp_ns(raw)))
        return found

    def read(self, name: str, entry: Entry) -> Message:
        """Read one message. Raises SourceError if it is damaged."""
        with self._lock:
            found = [raw for _, _, raw in self._raw([name], entry.recorded_ns, entry.recorded_ns + 1)]
        return self._decoded(name, found[entry.place])

    def _raw(
        self, names: Sequence[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic name, recording time and bytes of each message of the topics."""
        connections = [connection for connection in self._reader.connections if connection.topic in names]
        items = self._guarded(lambda: self._reader.messages(connections, start_ns, stop_ns))
        while (item := self._guarded(lambda: next(items, None))) is not None:
            yield item[0].topic, item[1], item[2]

    def _stamp_ns(self, raw: bytes) -> int:
        """Read the time of a header: ROS 1 starts with a sequence number, CDR with four bytes for the byte order."""
        if len(raw) < 12:
            raise SourceError(f"{self.path}: unreadable bag (a message of {len(raw)} bytes); copy it again")
        order = "<" if self.ros1 or raw[1] & 1 else ">"
        seconds, nanoseconds = struct.unpack_from(f"{order}II", raw, 4)
        return int(seconds) * 10**9 + int(nanoseconds)

    def _decoded(self, name: str, raw: bytes) -> Message:
        msgtype = self.topics[name].msgtype
        if not self.ros1:
            return self._guarded(lambda: self._types.deserialize_cdr(raw, msgtype))
        msgtype = TRANSFORMS if msgtype == "tf/msg/tfMessage" else msgtype  # the name of the type before ROS Hydro
        try:
            return self._types.deserialize_ros1(raw, msgtype)
        except Exception:  # RealSense's SDK appends the depth unit to images: four bytes
            return self._guarded(lambda: self._types.deserialize_ros1(raw[:-4], msgtype))

    def _guarded(self, call: Callable[[], Value]) -> Value:
        """Call the library. Raises SourceError for any of the exceptions that damaged bags can cause."""
        try:
            return call()
        except Exception as error:
            raise SourceError(
                f"{self.path}: unreadable bag ({error}); copy it again, or if its recording was interrupted repair it "
                "with rosbag reindex, ros2 bag reindex or mcap recover"
            ) from error


def is_bag(path: Path) -> bool:
    """Return whether a path is a ROS bag: a file by its first bytes, a folder by its metadata.yaml."""
    if path.is_dir():
        metadata = path / METADATA
        if not metadata.is_file():
            return False
        with open_regular(metadata) as file:
            return b"rosbag2_bagfile_information" in file.read(4096)
    return path.is_file() and _magic(path).startswith((ROS1_MAGIC, MCAP_MAGIC, SQLITE_MAGIC))


def list_topics(topics: Iterable[Topic], most: int = 12) -> str:
    """Format topics for an error message: names, types, counts."""
    words: Sequence[str] = [f"{t.name} ({t.msgtype.replace('/msg/', '/')}, {t.count})" for t in topics]
    return ", ".join(words[:most]) + (f", … {len(words)} topics" if len(words) > most else "") or "no topic"


def _magic(path: Path) -> bytes:
    with open_regular(path) as file:
        return file.read(16)
