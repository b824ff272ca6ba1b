"""Write values as JSON, whole files or a line at a time, and read them again."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from sigmasplat.errors import RunError
from sigmasplat.io.atomic import write_text


def plain(value: Any) -> Any:
    """Turn a value into what JSON can hold: arrays and tensors to lists, nan and inf to None, paths to text."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic | Tensor):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def write_json(path: Path, values: Any) -> None:
    """Write a file in one step. Raises RunError if the place cannot be written."""
    write_text(path, json.dumps(plain(values), indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Read a file. Raises RunError if it cannot be read or is not JSON."""
    try:
        return json.loads(read_text(path))
    except json.JSONDecodeError as problem:
        raise RunError(f"{path} is not JSON: {problem}") from problem


def append_line(path: Path, values: Any) -> None:
    """Add a line; it is on its way to disk when this returns. Raises RunError if the place cannot be written."""
    line = json.dumps(plain(values), allow_nan=False) + "\n"
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(line)
    except OSError as problem:
        raise RunError(f"cannot write {path}: {problem.strerror or problem}") from problem


def read_lines(path: Path) -> list[Any]:
    """Read what each line holds; a last line cut off by an interruption is passed over.

    Raises RunError if the file cannot be read or another line is damaged.
    """
    *whole, _cut_off = read_text(path).split("\n")
    values = []
    for number, line in enumerate(whole, 1):
        try:
            values.append(json.loads(line))
        except json.JSONDecodeError as problem:
            raise RunError(f"{path}:{number}: not JSON: {line[:60]!r}") from problem
    return values


def read_text(path: Path) -> str:
    """Read UTF-8 text. Raises RunError if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as problem:
        raise RunError(f"cannot read {path}: {problem}") from problem
