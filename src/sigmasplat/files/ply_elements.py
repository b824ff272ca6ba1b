"""Read the header of a binary PLY file, and the rows of its elements; make headers."""

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import SourceError

MAX_HEADER_BYTES = 1 << 20
PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
COUNT = re.compile("[0-9]{1,15}")
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class Element:
    """A kind of row: name, number of rows (−1 if the header is wrong), byte order, and the words of its properties."""

    name: str
    count: int
    order: str
    properties: tuple[tuple[str, ...], ...]

    def row_type(self, path: Path) -> np.dtype[np.void]:
        """Return the numpy type of a row. Raises SourceError on lists, unknown types or duplicate names."""
        unknown = [" ".join(words) for words in self.properties if len(words) != 2 or words[0] not in PLY_TYPES]
        names = [words[-1] for words in self.properties]
        if unknown or not names or len(set(names)) < len(names):
            found = ", ".join(unknown) or ("a name occurs twice" if names else f"'{self.name}' has none")
            raise SourceError(f"{path}: cannot read the PLY's properties ({found})")
        return np.dtype([(name, self.order + PLY_TYPES[kind]) for kind, name in self.properties])

    def read(self, file: BinaryIO, path: Path) -> NDArray[np.void]:
        """Read the rows from the file's current position. Raises SourceError if the file is too short."""
        row_type = self.row_type(path)
        size = self.count * row_type.itemsize
        left = os.fstat(file.fileno()).st_size - file.tell()
        if left < size:
            what = "splats" if self.name == "vertex" else f"rows of '{self.name}'"
            raise SourceError(f"{path} is truncated: its header says {self.count} {what} = {size} bytes, found {left}")
        return np.frombuffer(file.read(size), row_type)


def header_of(*elements: tuple[str, int, Iterable[str]], comment: str = "") -> bytes:
    """Return the header of a binary little-endian PLY: name, number of rows and properties ("float x") of elements."""
    lines = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] * bool(comment))]
    for name, count, properties in elements:
        lines += [f"element {name} {count}", *(f"property {words}" for words in properties)]
    return "".join(f"{line}\n" for line in [*lines, "end_header"]).encode("ascii")


def read_header(file: BinaryIO, path: Path) -> list[Element]:
    """Read the header: the elements in the order of their rows. Raises SourceError if it is not a binary PLY."""
    if file.readline(8).strip() != b"ply":
        raise SourceError(f"{path} is not a PLY file (its first line is not 'ply'); give a binary PLY")
    lines = _header_lines(file, path)
    order = BYTE_ORDERS.get(lines[0][1]) if lines and lines[0][0] == "format" and len(lines[0]) > 1 else None
    if order is None:
        found = " ".join(lines[0]) if lines else "no format"
        raise SourceError(f"{path}: the PLY is not binary ({found}); save it as binary")
    starts = [i for i, line in enumerate(lines) if line[0] == "element"]
    elements = []
    for start, end in pairwise([*starts, len(lines)]):
        name, count = (*lines[start][1:], "", "")[:2]
        properties = tuple(tuple(line[1:]) for line in lines[start + 1 : end] if line[0] == "property")
        elements.append(Element(name, int(count) if COUNT.fullmatch(count) else -1, order, properties))
    return elements


def _header_lines(file: BinaryIO, path: Path) -> list[list[str]]:
    """Return the words of each header line except comments. Raises SourceError without 'end_header'."""
    lines: list[list[str]] = []
    while file.tell() < MAX_HEADER_BYTES and (raw := file.readline(MAX_HEADER_BYTES)):
        words = raw.decode("ascii", "replace").split()
        if words == ["end_header"]:
            return lines
        if words and words[0] not in ("comment", "obj_info"):
            lines.append(words)
    raise SourceError(f"{path} is truncated: the PLY's header has no 'end_header'")
