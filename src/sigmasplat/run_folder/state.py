"""Write a tree of objects and read it back bit for bit, so that a stopped run can resume.

No pickles are used: reading a file can only create numbers, text, and instances of the classes that the reader names.
A checksum refuses a damaged state before a run continues it.
"""

import dataclasses
import json
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sigmasplat.data.poses import Column
from sigmasplat.errors import RunError
from sigmasplat.files.tensors import open_tensors, write_tensors

INLINE = 64
"""Arrays with at most this many numbers are stored in the text, since there are many poses and each tensor needs a
header."""
FORMAT = "9"
TEXT = "state"
"""Name of the tensor with the tree as JSON, bytes."""
_json = json.JSONEncoder().encode


def write_state(path: Path, tree: Any, classes: Iterable[type], fixed: Mapping[str, Any]) -> None:
    """Write a tree of dataclasses, named tuples, lists, tuples, dicts, arrays, tensors, numbers, text and None.

    fixed: objects by name that the reader already has; only their names are written. Raises RunError if the file cannot
    be written, TypeError on any other type in the tree.
    """
    known = {c.__name__: c for c in classes}
    encoder = _Encoder(known, {id(value): name for name, value in fixed.items()})
    text = encoder.text(tree).encode()
    encoder.tensors[TEXT] = torch.frombuffer(bytearray(text), dtype=torch.uint8)
    write_tensors(path, encoder.tensors, {"version": _version(known), "checksum": _checksum(encoder.tensors)})


def read_state(path: Path, classes: Iterable[type], fixed: Mapping[str, Any]) -> Any:
    """Read a file of `write_state`. Raises RunError if it is missing, damaged, or of another version."""
    if not path.is_file():
        raise RunError(f"nothing to resume: no {path}")
    known = {c.__name__: c for c in classes}
    with open_tensors(path, "state") as file:
        facts = file.metadata() or {}
        if facts.get("version") != _version(known):
            raise RunError(f"{path} was written by another version ({facts.get('version')}); run it again")
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if facts.get("checksum") != _checksum(tensors):
            raise ValueError("its checksum is wrong")
        tree = json.loads(tensors[TEXT].numpy().tobytes())
        return _Decoder(tensors, known, fixed).decode(tree)


def _version(classes: Mapping[str, type]) -> str:
    """Return the version of the format with a checksum of the classes' fields: other code has other fields."""
    layout = {name: _names(c) for name, c in sorted(classes.items())}
    return f"{FORMAT}.{zlib.crc32(_json(layout).encode()):08x}"


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    found = 0
    for name in sorted(tensors):
        found = zlib.crc32(tensors[name].numpy().tobytes(), found)
    return f"{found:08x}"


def _names(made: Any) -> list[str]:
    """Return the fields of a named tuple, or those of a dataclass that its constructor takes."""
    return (
        [f.name for f in dataclasses.fields(made) if f.init] if dataclasses.is_dataclass(made) else list(made._fields)
    )


class _Encoder:
    """Converts objects to JSON text. Large arrays are collected as tensors. An array that is used twice is stored once,
    so that it is still shared after reading.

    The text is made part by part. After a long run, a tree of millions of JSON values, or one call that writes them
    all, would hold Python's lock for a second, and tracking in real time would have to wait.
    """

    def __init__(self, classes: Mapping[str, type], fixed: Mapping[int, str]) -> None:
        self.classes, self.fixed = classes, fixed
        self.tensors: dict[str, Tensor] = {}
        self.seen: dict[int, tuple[str, Any]] = {}

    def text(self, value: Any) -> str:
        """Return a value as JSON."""
        if id(value) in self.fixed:
            return _json({"fixed": self.fixed[id(value)]})
        if value is None or isinstance(value, bool | int | float | str):
            return _json(value)
        if isinstance(value, np.generic):
            return _json(value.item())
        if isinstance(value, Tensor | np.ndarray):
            return _json(self._array(value))
        if isinstance(value, list):
            return self._list(value)
        if isinstance(value, dict):
            pairs = ", ".join(f"[{self.text(key)}, {self.text(item)}]" for key, item in value.items())
            return f'{{"dict": [{pairs}]}}'
        if isinstance(value, Column):
            return self._column(value)
        name = type(value).__name__
        if self.classes.get(name) is type(value):
            fields = ", ".join(f"{_json(n)}: {self.text(getattr(value, n))}" for n in _names(value))
            return f'{{"object": {_json(name)}, "fields": {{{fields}}}}}'
        if type(value) is tuple:
            return f'{{"tuple": {self._list(value)}}}'
        raise TypeError(f"a state cannot hold {type(value)}")

    def _list(self, values: Iterable[Any]) -> str:
        return f"[{', '.join(map(self.text, values))}]"

    def _column(self, column: Column) -> str:
        """Return a column, whose values are not copied: most of a long state is in columns."""
        values = self._array(column.used, torch.from_numpy)
        fields = f'{{"values": {_json(values)}, "count": {len(column)}}}'
        return f'{{"object": "Column", "fields": {fields}}}'

    def _array(self, value: Tensor | np.ndarray[Any, Any], kept: Callable[..., Tensor] = torch.tensor) -> Any:
        kind = "tensor" if isinstance(value, Tensor) else "array"
        array = value.detach().cpu().numpy() if isinstance(value, Tensor) else value
        device = {"device": "cuda"} if isinstance(value, Tensor) and value.is_cuda else {}
        if array.size <= INLINE:
            return {kind: array.tolist(), "type": str(array.dtype), "shape": list(array.shape)} | device
        if id(value) not in self.seen:
            name = str(len(self.tensors))
            self.tensors[name] = kept(array)
            self.seen[id(value)] = name, value  # keeps the object alive, so that its id is not used again
        return {kind: self.seen[id(value)][0]} | device


class _Decoder:
    def __init__(self, tensors: Mapping[str, Tensor], classes: Mapping[str, type], fixed: Mapping[str, Any]) -> None:
        self.tensors, self.classes, self.fixed = tensors, classes, fixed
        self.arrays = {name: tensor.numpy() for name, tensor in tensors.items()}

    def decode(self, value: Any) -> Any:
        if isinstance(value, list):
            return [self.decode(item) for item in value]
        if not isinstance(value, dict):
            return value
        if "fixed" in value:
            return self.fixed[value["fixed"]]
        if "dict" in value:
            return {self.decode(key): self.decode(item) for key, item in value["dict"]}
        if "tuple" in value:
            return tuple(self.decode(item) for item in value["tuple"])
        if "object" in value:
            return self.classes[value["object"]](**{n: self.decode(v) for n, v in value["fields"].items()})
        return self._array(value)

    def _array(self, value: dict[str, Any]) -> Any:
        kind = "tensor" if "tensor" in value else "array"
        if isinstance(value[kind], str):
            name = value[kind]
            return self.tensors[name].to(value.get("device", "cpu")) if kind == "tensor" else self.arrays[name]
        array = np.array(value[kind], value["type"]).reshape(value["shape"])
        return torch.from_numpy(array).to(value.get("device", "cpu")) if kind == "tensor" else array
