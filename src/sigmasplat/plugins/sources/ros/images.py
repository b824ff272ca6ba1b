"""Decode image messages of ROS: sensor_msgs/Image and sensor_msgs/CompressedImage.

Raw encodings are those of sensor_msgs' image_encodings.hpp. Compressed depth is that of image_transport's plugin
compressed_depth: a header of 12 bytes (format, two quantisation parameters a and b), then a PNG. For 16UC1 the PNG
holds the values, for 32FC1 it holds a / depth + b.
"""

import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import SourceError
from sigmasplat.input.images import decode_color, depth_to_metres, image_size, read_values
from sigmasplat.plugins.sources.ros.bag import Message

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
ImageKind = Literal["colour", "depth", ""]

COLOR_ORDER = {
    "rgb8": (0, 1, 2),
    "bgr8": (2, 1, 0),
    "8UC3": (2, 1, 0),
    "rgba8": (0, 1, 2),
    "bgra8": (2, 1, 0),
    "8UC4": (2, 1, 0),
}
"""Positions of red, green and blue in a pixel."""
DEPTH_TYPE = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
GRAY = ("mono8", "8UC1")
HEADER_BYTES = 12


def image_kind(message: Message) -> ImageKind:
    """Return the kind of an image message; "" if it is neither colour nor depth, such as infrared."""
    if hasattr(message, "encoding"):
        return "colour" if message.encoding in COLOR_ORDER else "depth" if message.encoding in DEPTH_TYPE else ""
    text = message.format
    if "compressedDepth" in text or text.startswith(("16UC1", "mono16")):
        return "depth"
    return "" if text.startswith(("mono8", "8UC1")) else "colour"


def message_size(path: Path, message: Message) -> tuple[int, int]:
    """Return (width, height) in pixels. Raises SourceError naming `path` if a compressed image has no header."""
    if hasattr(message, "encoding"):
        return int(message.width), int(message.height)
    data = message.data.tobytes()
    start = HEADER_BYTES if "compressedDepth" in message.format else 0
    return image_size(path, data[start:])


def decode_color_message(path: Path, message: Message) -> NDArray[np.uint8]:
    """Return 8-bit RGB [H, W, 3]. Raises SourceError naming `path` if the message is damaged or not colour."""
    if not hasattr(message, "encoding"):
        return decode_color(path, message.data.tobytes())
    if message.encoding not in COLOR_ORDER:
        raise _encoding(path, "colour", message.encoding, COLOR_ORDER)
    pixels = _pixels(path, message, "u1", 4 if message.encoding in ("rgba8", "bgra8", "8UC4") else 3)
    return np.ascontiguousarray(pixels[..., COLOR_ORDER[message.encoding]])


def decode_any_color(path: Path, message: Message) -> NDArray[np.uint8]:
    """Return 8-bit RGB [H, W, 3] of a colour or a gray image, such as infrared. Raises as `decode_color_message`."""
    if getattr(message, "encoding", "") in GRAY:
        return np.repeat(_pixels(path, message, "u1", 1), 3, axis=2)
    return decode_color_message(path, message)


def decode_depth_message(path: Path, message: Message, units_per_metre: float) -> NDArray[np.float32]:
    """Return depth in metres [H, W], 0 = no reading; whole numbers are divided by `units_per_metre`.

    Raises SourceError naming `path` if the message is damaged or not a depth image.
    """
    if not hasattr(message, "encoding"):
        return _decompressed(path, message, units_per_metre)
    if message.encoding not in DEPTH_TYPE:
        raise _encoding(path, "depth", message.encoding, DEPTH_TYPE)
    raw = _pixels(path, message, DEPTH_TYPE[message.encoding], 1)[..., 0]
    return depth_to_metres(path, _without_nan(raw) if raw.dtype.kind == "f" else raw, units_per_metre)


def _decompressed(path: Path, message: Message, units_per_metre: float) -> NDArray[np.float32]:
    if "rvl" in message.format.lower():
        raise SourceError(f"{path}: depth is compressed as RVL, which is not supported; republish it as PNG or raw")
    data = message.data.tobytes()
    has_header = "compressedDepth" in message.format
    raw = read_values(path, data[HEADER_BYTES * has_header :])
    if not (has_header and message.format.startswith("32FC1")):
        return depth_to_metres(path, raw, units_per_metre)
    a, b = struct.unpack_from("<ff", data, 4)
    with np.errstate(divide="ignore", invalid="ignore"):
        return depth_to_metres(path, _without_nan(np.where(raw > 0, a / (raw - b), 0.0)), units_per_metre)


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


def _without_nan(depth_m: NDArray[Any]) -> NDArray[np.float32]:
    """Return float depth with 0 for NaN (no reading) and infinity (out of range), see REP 117."""
    filled: NDArray[np.float32] = np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)
    return filled


def _encoding(path: Path, what: str, found: str, known: dict[str, Any]) -> SourceError:
    return SourceError(
        f"{path}: {what} is encoded as {found}, which is not supported; supported are {', '.join(known)}"
    )
