"""Write and read JSON files, and files with one JSON value per line."""

import json
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from sigmasplat.errors import RunError
from sigmasplat.files import reading
from sigmasplat.files.atomic import replacing, write_text
from sigmasplat.files.reading import MOST_OWN_JSON_BYTES, parse_json


def to_json(value: Any) -> Any:
    """Convert a value to JSON's types: arrays and tensors to lists, nan and inf to None, paths to text."""
    if isinstance(value, dict):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, np.ndarray | np.generic | Tensor):
        return to_json(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def write_json(path: Path, values: Any) -> None:
    """Write a file atomically, a list with one line per item. Raises RunError if it cannot be written.

    An iterator is written as a list, without ever being in memory as a whole.
    """
    if isinstance(values, list | Iterator):
        _write_items(path, values)  # may be many, and indenting is slow
    else:
        write_text(path, json.dumps(to_json(values), indent=2, allow_nan=False) + "\n")


def _write_items(path: Path, items: Iterable[Any]) -> None:
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        before = "[\n"
        for item in items:
            file.write(before + json_line(item).rstrip())
            before = ",\n"
        file.write("[]\n" if before == "[\n" else "\n]\n")


def read_json(path: Path) -> Any:
    """Read a file. Raises RunError if it cannot be read or is not JSON."""
    return reading.read_json(path, RunError, MOST_OWN_JSON_BYTES)


def json_line(values: Any) -> str:
    """Return a value as one line of JSON, with the line break."""
    return json.dumps(to_json(values), allow_nan=False) + "\n"


def append_line(path: Path, values: Any) -> None:
    """Append a line and flush it to the operating system. Raises RunError if the file cannot be written."""
    line = json_line(values)
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(line)
    except OSError as problem:
        raise RunError(f"cannot write {path}: {problem.strerror or problem}") from problem


def read_lines(path: Path) -> list[Any]:
    """Read the value of each line; an incomplete last line, left by an interruption, is skipped.

    Raises RunError if the file cannot be read or another line is damaged.
    """
    *complete, _incomplete = read_text(path).split("\n")
    return [parse_json(line, f"{path}:{number}", RunError) for number, line in enumerate(complete, 1)]


def read_text(path: Path) -> str:
    """Read UTF-8 text. Raises RunError if it cannot be read."""
    return reading.read_text(path, RunError, MOST_OWN_JSON_BYTES)
