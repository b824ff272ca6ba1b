"""Read a glTF 2.0 file, as GLB or text: its JSON document, and the numbers of an attribute of a primitive.

Sizes are checked before numbers are read. Sparse accessors and compressed buffers cannot be read.
"""

import base64
import binascii
import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sigmasplat.errors import SourceError
from sigmasplat.files.reading import open_binary
from sigmasplat.run_folder.quaternions import Doubles

FLOAT = 5126
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
DATA_URI = "data:application/octet-stream;base64,"
UNMOVED = {
    "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
    "translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1],
}  # fmt: skip


@dataclass(frozen=True)
class GltfFile:
    """The JSON document of a file, and the data chunk of a GLB."""

    path: Path
    document: Mapping[str, Any]
    chunk: bytes

    @staticmethod
    def open(path: Path) -> "GltfFile":
        """Read a file. Raises SourceError if it is missing, damaged, or not glTF 2.0."""
        with open_binary(path, "cannot read map") as file:
            data = file.read()
        chunk = b""
        if data.startswith(b"glTF"):
            data, chunk = _chunks(data, path)
        try:
            document = json.loads(data)
            version = str(document["asset"]["version"])
        except (ValueError, TypeError, KeyError, RecursionError) as problem:
            raise SourceError(f"{path} is not glTF 2.0, or is damaged or truncated: {problem}") from problem
        if not version.startswith("2."):
            raise SourceError(f"{path} is glTF {version}; only glTF 2.0 can be read")
        return GltfFile(path, document, chunk)

    @staticmethod
    def data_uri(data: bytes) -> str:
        """Return a URI that contains the data of a buffer."""
        return DATA_URI + base64.b64encode(data).decode("ascii")

    def damaged(self, what: str) -> SourceError:
        """Return the error of a file whose document is wrong."""
        return SourceError(f"{self.path} is damaged or not supported: {what}")

    def entry(self, kind: str, index: object) -> Mapping[str, Any]:
        """Return an entry of a list of the document, such as accessor 3. Raises SourceError."""
        entries = self.document.get(kind)
        if isinstance(index, bool) or not isinstance(index, int) or not isinstance(entries, list):
            raise self.damaged(f"{kind} {index} is missing")
        if not 0 <= index < len(entries) or not isinstance(entries[index], Mapping):
            raise self.damaged(f"{kind} {index} is missing")
        found: Mapping[str, Any] = entries[index]
        return found

    def primitive(self, extension: str) -> Mapping[str, Any] | None:
        """Return the first primitive with an extension; None without one. Raises SourceError if its node is moved."""
        meshes = self.document.get("meshes")
        for i in range(len(meshes) if isinstance(meshes, list) else 0):
            for primitive in self._list(self.entry("meshes", i), "primitives"):
                found: Mapping[str, Any] = primitive if isinstance(primitive, Mapping) else {}
                extensions = found.get("extensions")
                if isinstance(extensions, Mapping) and extension in extensions:
                    self._check_node(i)
                    return found
        return None

    def _check_node(self, mesh: int) -> None:
        for node in self._list(self.document, "nodes"):
            if isinstance(node, Mapping) and (node.get("mesh") == mesh or "children" in node):
                for name, value in UNMOVED.items():
                    if node.get(name, value) != value:
                        raise self.damaged(f"its splats are moved by the {name} of a node; apply it before saving")

    def _list(self, owner: Mapping[str, Any], name: str) -> list[Any]:
        found = owner.get(name, [])
        if not isinstance(found, list):
            raise self.damaged(f"{name} is not a list")
        return found

    def has(self, primitive: Mapping[str, Any], name: str) -> bool:
        """Return whether a primitive has an attribute."""
        attributes = primitive.get("attributes")
        return isinstance(attributes, Mapping) and name in attributes

    def attribute(self, primitive: Mapping[str, Any], name: str, width: int) -> Doubles:
        """Return an attribute [N, width], normalised integers as numbers in [−1, 1], N as for POSITION.

        Raises SourceError if it is missing, outside of its buffer, or not finite.
        """
        if not self.has(primitive, name):
            raise self.damaged(f"it has no attribute {name}")
        accessor = self.entry("accessors", primitive["attributes"][name])
        kind, size, at = (self._whole(accessor, key) for key in ("componentType", "count", "byteOffset"))
        if kind not in COMPONENTS or WIDTHS.get(str(accessor.get("type"))) != width or "sparse" in accessor:
            raise self.damaged(f"{name} is not a plain accessor of {width} numbers")
        rows = self.entry("accessors", primitive["attributes"].get("POSITION")).get("count")
        if size != rows:
            raise self.damaged(f"{name} has {size} values for {rows} splats")
        item = np.dtype(COMPONENTS[kind])
        view = self.entry("bufferViews", accessor.get("bufferView"))
        if view.get("extensions"):
            raise self.damaged(f"the buffer of {name} is compressed; save the map without compression")
        stride = self._whole(view, "byteStride") or width * item.itemsize
        start, length = self._whole(view, "byteOffset") + at, self._whole(view, "byteLength") - at
        data = self._buffer(view.get("buffer"))
        if stride < width * item.itemsize or size * stride - stride + width * item.itemsize > length * bool(size):
            raise self.damaged(f"{name} is larger than its part of the buffer")
        if start + length > len(data):
            raise SourceError(f"{self.path} is truncated: {name} ends at byte {start + length} of {len(data)}")
        values = np.ndarray((size, width), item, data, start, (stride, item.itemsize)).astype(np.float64)
        if accessor.get("normalized"):
            values = np.maximum(values / np.iinfo(item).max, -1.0) if kind != FLOAT else values
        if not np.isfinite(values).all():
            raise SourceError(f"{self.path}: {name} has nan or inf")
        return values

    def _whole(self, owner: Mapping[str, Any], name: str) -> int:
        found = owner.get(name, 0)
        if isinstance(found, bool) or not isinstance(found, int) or not 0 <= found < 1 << 53:
            raise self.damaged(f"{name} is not a whole number")
        return found

    def _buffer(self, index: object) -> bytes:
        """Return the data of a buffer: the chunk of a GLB, a data URI, or a file beside the document."""
        uri = self.entry("buffers", index).get("uri")
        if uri is None:
            return self.chunk
        if not isinstance(uri, str):
            raise self.damaged("the URI of a buffer is not text")
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except binascii.Error as problem:
                raise self.damaged("the data of a buffer is not base64") from problem
        if Path(uri).name != uri or uri in ("", ".", ".."):
            raise self.damaged("the URI of a buffer is not a file in the same folder")
        with open_binary(self.path.with_name(uri), f"cannot read the data of {self.path}:") as file:
            return file.read()


def _chunks(data: bytes, path: Path) -> tuple[bytes, bytes]:
    """Split a GLB into its document and its data. Raises SourceError."""
    version, length = struct.unpack_from("<II", data, 4) if len(data) >= 12 else (2, len(data) + 1)
    if version != 2 or length > len(data):
        what = f"is a GLB of version {version}" if version != 2 else "is truncated"
        raise SourceError(f"{path} {what}: its header says {length} bytes, found {len(data)}")
    parts: dict[bytes, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, at)
        if at + 8 + size > length:
            raise SourceError(f"{path} is truncated: a chunk says {size} bytes, found {length - at - 8}")
        parts.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    return parts.get(b"JSON", b""), parts.get(b"BIN\0", b"")
