"""Read topics and messages of ROS bags without ROS, through the rosbags package (Apache-2.0), and decode images.

ROS 1 is one file that starts with "#ROSBAG V2.0"; ROS 2 is a folder with metadata.yaml, or one of its storage files:
MCAP (starts with 89 "MCAP0"), SQLite (.db3). Raw encodings of images are those of sensor_msgs' image_encodings.hpp.
Compressed depth is that of image_transport's plugin compressed_depth: a header of 12 bytes (format, two quantisation
parameters a and b), then a PNG. For 16UC1 the PNG holds the values, for 32FC1 it holds a / depth + b.
"""

import struct
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

import sigmasplat.api as api
from sigmasplat.api import SourceError

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
                api.refuse_special(file, most=MOST_METADATA_BYTES if file.name == METADATA else None)
        self.ros1 = path.is_file() and _magic(path).startswith(ROS1_MAGIC)
        reader = api.import_optional(
            "rosbags.rosbag1" if self.ros1 else "rosbags.rosbag2", "ros", f"{path}: a ROS bag"
        ).Reader
        typesys = api.import_optional("rosbags.typesys", "ros", f"{path}: a ROS bag")
        # The common message types never changed; the type definitions stored in a bag are not needed and may be wrong.
        self._types = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if self.ros1 else typesys.Stores.LATEST)
        if TRANSFORMS not in self._types.fielddefs:
            fields = "geometry_msgs/TransformStamped[] transforms"
            self._types.register(typesys.get_types_from_msg(fields, TRANSFORMS))
        self._reader = self._guarded(lambda: reader(path))
        self._guarded(self._reader.open)
        weakref.finalize(self, self._reader.close)
        self.topics = {  # ROS 1 records names that lack their slash
            f"/{name.lstrip('/')}": Topic(f"/{name.lstrip('/')}", info.msgtype or "", info.msgcount)
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
        known = [name.lstrip("/") for name in names]
        connections = [connection for connection in self._reader.connections if connection.topic.lstrip("/") in known]
        items = self._guarded(lambda: self._reader.messages(connections, start_ns, stop_ns))
        while (item := self._guarded(lambda: next(items, None))) is not None:
            yield f"/{item[0].topic.lstrip('/')}", item[1], item[2]

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
        try:
            return call()
        except Exception as error:
            raise SourceError(
                f"{self.path}: unreadable bag ({error}); copy it again, or if its recording was interrupted repair it "
                "with rosbag reindex, ros2 bag reindex or mcap recover"
            ) from error


def is_bag(path: Path) -> bool:
    """Return whether a path is a ROS bag: a file by its first bytes and tables, a folder by its metadata.yaml."""
    if path.is_dir():
        metadata = path / METADATA
        if not metadata.is_file():
            return False
        with api.open_regular(metadata) as file:
            return b"rosbag2_bagfile_information" in file.read(4096)
    known = path.is_file() and _magic(path).startswith((ROS1_MAGIC, MCAP_MAGIC, SQLITE_MAGIC))
    return known and (not (tables := api.sqlite_tables(path)) or {"topics", "messages"} <= tables)


def list_topics(topics: Iterable[Topic], most: int = 12) -> str:
    """Format topics for an error message: names, types, counts."""
    words: Sequence[str] = [f"{t.name} ({t.msgtype.replace('/msg/', '/')}, {t.count})" for t in topics]
    return ", ".join(words[:most]) + (f", … {len(words)} topics" if len(words) > most else "") or "no topic"


def _magic(path: Path) -> bytes:
    with api.open_regular(path) as file:
        return file.read(16)


RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
ImageKind = Literal["colour", "gray", "depth", ""]

COLOR_FORMS: dict[str, tuple[int, Sequence[int] | str]] = {
    **{"rgb8": (3, (0, 1, 2)), "rgba8": (4, (0, 1, 2)), "mono8": (1, (0, 0, 0)), "8UC1": (1, (0, 0, 0))},
    **{name: (3 + (name in ("bgra8", "8UC4")), (2, 1, 0)) for name in ("bgr8", "8UC3", "bgra8", "8UC4")},
    **{name: (2, "COLOR_YUV2RGB_UYVY") for name in ("yuv422", "uyvy")},
    **{name: (2, "COLOR_YUV2RGB_YUY2") for name in ("yuv422_yuy2", "yuyv")},
    **{f"bayer_{order}8": (1, f"COLOR_Bayer{order.upper()}2RGB") for order in ("rggb", "bggr", "gbrg", "grbg")},
}
"""Channels of an image, and the positions of red, green and blue in a pixel, or OpenCV's conversion. Colours of 16
bits, such as rgb16, are read as those of 8; gray of 16 bits stays as stored."""
DEPTH_TYPE = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
HEADER_BYTES = 12


def image_kind(message: Message) -> tuple[ImageKind, str]:
    """Return the kind of an image message, "" if it cannot be read, and how its pixels are stored, in words of ROS."""
    raw = hasattr(message, "encoding")
    text = str(message.encoding if raw else message.format)
    gray_16 = not raw and (message.data[:4].tobytes(), message.data[24:26].tobytes()) == (b"\x89PNG", b"\x10\0")
    if "compressedDepth" in text or text.startswith(tuple(DEPTH_TYPE)) or gray_16:
        return "" if "rvl" in text.lower() else "depth", text
    known: ImageKind = "gray" if text.startswith(("mono8", "8UC1")) else "colour"
    return known if not raw or text.replace("16", "8") in COLOR_FORMS else "", text


def message_size(path: Path, message: Message) -> tuple[int, int]:
    """Return (width, height) in pixels. Raises SourceError naming `path` if a compressed image has no header."""
    if hasattr(message, "encoding"):
        return int(message.width), int(message.height)
    data = message.data.tobytes()
    if "rvl" in message.format.lower():
        return 0, 0  # RVL is not supported
    start = HEADER_BYTES if "compressedDepth" in message.format else 0
    return api.image_size(path, data[start:])


def decode_color_message(path: Path, message: Message) -> NDArray[Any]:
    """Return 8-bit RGB [H, W, 3], or gray of more bits [H, W], as `read_color`. Raises SourceError naming `path` if the
    message is damaged or not colour."""
    if not hasattr(message, "encoding"):
        return api.read_color(path, message.data.tobytes())
    wide, name = "16" in message.encoding, message.encoding.replace("16", "8")
    if name not in COLOR_FORMS:
        raise _encoding(path, "colour", message.encoding, COLOR_FORMS)
    channels, order = COLOR_FORMS[name]
    stored = _pixels(path, message, "u2" if wide else "u1", channels)
    if wide and order == (0, 0, 0):
        return stored[..., 0]
    pixels = (stored >> (8 * wide)).astype(np.uint8)
    if isinstance(order, str):
        return np.asarray(api.opencv().cvtColor(pixels, getattr(api.opencv(), order)), np.uint8)
    return np.ascontiguousarray(pixels[..., order])


def decode_depth_message(path: Path, message: Message, units_per_metre: float) -> NDArray[np.float32]:
    """Return depth in metres [H, W], 0 = no reading; whole numbers are divided by `units_per_metre`.

    Raises SourceError naming `path` if the message is damaged or not a depth image.
    """
    if not hasattr(message, "encoding"):
        return _decompressed(path, message, units_per_metre)
    if message.encoding not in DEPTH_TYPE:
        raise _encoding(path, "depth", message.encoding, DEPTH_TYPE)
    raw = _pixels(path, message, DEPTH_TYPE[message.encoding], 1)[..., 0]
    return api.depth_to_metres(path, api.without_nan(raw) if raw.dtype.kind == "f" else raw, units_per_metre)


def _decompressed(path: Path, message: Message, units_per_metre: float) -> NDArray[np.float32]:
    data = message.data.tobytes()
    has_header = "compressedDepth" in message.format
    raw = api.read_values(path, data[HEADER_BYTES * has_header :])
    if not (has_header and message.format.startswith("32FC1")):
        return api.depth_to_metres(path, raw, units_per_metre)
    a, b = struct.unpack_from("<ff", data, 4)
    with np.errstate(divide="ignore", invalid="ignore"):
        return api.depth_to_metres(path, api.without_nan(np.where(raw > 0, a / (raw - b), 0.0)), units_per_metre)


def _pixels(path: Path, message: Message, kind: str, channels: int) -> NDArray[Any]:
    """Return [H, W, channels]; rows may be padded, and both byte orders are supported."""
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    row = message.width * channels * dtype.itemsize
    if len(message.data) != message.height * message.step or message.step < row:
        raise SourceError(
            f"{path}: unreadable image ({len(message.data)} bytes for {message.width}×{message.height} "
            f"{message.encoding}); record it again"
        )
    rows = message.data.reshape(message.height, message.step)[:, :row]
    return np.ascontiguousarray(rows).view(dtype).reshape(message.height, message.width, channels)


def _encoding(path: Path, what: str, found: str, known: dict[str, Any]) -> SourceError:
    return SourceError(
        f"{path}: {what} is encoded as {found}, which is not supported; supported are {', '.join(known)}"
    )
