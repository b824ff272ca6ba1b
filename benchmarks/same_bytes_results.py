"""Compare the files of two run folders: what a run computed, without times, paths and the machine."""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

Value = Any
"""A number, a text, a truth value, None, or an array."""
DONE = "same-bytes.json"
"""In the folder of a kept run: its words and processor time."""
NOT_COMPARED = {DONE, "config.json", "report.html", "images", ".lock"}
"""Settings, times and pictures."""
LEFT_OUT = {
    "seconds", "wall_s", "finish_s", "total_s", "frames_per_s", "worst_frame_s",
    "program", "version", "code", "machine", "isa", "source_path",
}  # fmt: skip
"""Keys that tell of time, machine or checkout."""
END_OF_HEADER = b"end_header\n"


Files = dict[str, dict[str, Value]]
"""The values of a run by file and by name; a name has the steps of nested values, joined by dots."""


def read_run(folder: Path, renamed: Mapping[str, str]) -> Files:
    """Read a run folder; `renamed` gives new names of files and keys, "" for what is left out."""
    files = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and not NOT_COMPARED & set(name.split("/")) and renamed.get(name, name):
            values = ((_renamed(key, renamed), value) for key, value in values_of(path))
            kept = {key: value for key, value in values if key is not None and not LEFT_OUT & set(key.split("."))}
            files[renamed.get(name, name)] = kept
    return files


def _renamed(key: str, renamed: Mapping[str, str]) -> str | None:
    """Return a name with every renamed part replaced; None if a part is left out."""
    for old, new in renamed.items():
        if f".{old}." in f".{key}.":
            if not new:
                return None
            key = f".{key}.".replace(f".{old}.", f".{new}.").strip(".")
    return key


def values_of(path: Path) -> Iterator[tuple[str, Value]]:
    """Yield the names and values in a file, in its order."""
    if path.suffix == ".json":
        yield from _flat(json.loads(path.read_text()), "")
    elif path.suffix == ".jsonl":
        yield from _flat([json.loads(line) for line in path.read_text().splitlines()], "")
    elif path.suffix == ".txt":
        yield from _flat([[_number(word) for word in line.split()] for line in path.read_text().splitlines()], "")
    elif path.suffix == ".safetensors":
        with safe_open(path, "np") as tensors:
            yield from sorted((tensors.metadata() or {}).items())  # their order in the file varies from run to run
            yield from ((name, tensors.get_tensor(name)) for name in sorted(tensors.keys()))
    elif path.suffix == ".ply":
        header, _, rows = path.read_bytes().partition(END_OF_HEADER)
        yield "header", header.decode()
        yield "rows", np.frombuffer(rows, np.uint8 if len(rows) % 4 else "<f4")
    else:
        yield "bytes", np.frombuffer(path.read_bytes(), np.uint8)


def _flat(value: Any, name: str) -> Iterator[tuple[str, Value]]:
    if not isinstance(value, dict | list) or not value:
        yield name, str(value) if isinstance(value, dict | list) else value
        return
    for key, item in value.items() if isinstance(value, dict) else enumerate(value):
        yield from _flat(item, f"{name}.{key}" if name else str(key))


def _number(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word


def differences(before: Files, now: Files) -> dict[str, str]:
    """Return what differs by file, in words; empty if all values are the same bit by bit."""
    found = {}
    for name in sorted({*before, *now}):
        if name not in now or name not in before:
            found[name] = f"only {'now' if name in now else 'before'}"
        elif said := _difference(before[name], now[name]):
            found[name] = said
    return found


def _difference(before: Mapping[str, Value], now: Mapping[str, Value]) -> str:
    """Say which values of a file differ: how many, the first, the largest difference, names on one side; "" if none."""
    both = [name for name in before if name in now]
    changed = [name for name in both if not _same(before[name], now[name])]
    said = []
    if changed:
        first = changed[0]
        said.append(f"{len(changed)} of {len(both)} values differ, first {first}: {_shown(before[first], now[first])}")
        sizes = {name: size for name in changed if (size := _size(before[name], now[name])) is not None}
        if len(sizes) > 1:
            largest = max(sizes, key=lambda name: sizes[name])
            said.append(f"largest difference {sizes[largest]:.3g} in {largest}")
    for side, names in (("before", before.keys() - now.keys()), ("now", now.keys() - before.keys())):
        if names:
            said.append(f"only {side}: {', '.join(_patterns(names))}")
    return "; ".join(said)


def _same(a: Value, b: Value) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return type(a) is type(b) and repr(a) == repr(b)


def _size(a: Value, b: Value) -> float | None:
    """Return the largest absolute difference; None for what has no difference in numbers."""
    pair = [np.asarray(value) for value in (a, b)]
    if any(array.dtype.kind not in "iufb" for array in pair) or pair[0].shape != pair[1].shape or not pair[0].size:
        return None
    first, second = (array.astype(np.float64) for array in pair)
    return float(np.nanmax(np.abs(first - second), initial=0.0))


def _shown(a: Value, b: Value) -> str:
    """Show two different values: before → now, with the size of the difference."""
    if not isinstance(a, np.ndarray) or not isinstance(b, np.ndarray):
        size = _size(a, b)
        return f"{_short(a)} → {_short(b)}" + ("" if size is None else f" ({size:.3g})")
    if a.shape != b.shape or a.dtype != b.dtype:
        return f"{a.dtype}{list(a.shape)} → {b.dtype}{list(b.shape)}"
    different = np.flatnonzero(_bits(a) != _bits(b))
    place = tuple(int(index) for index in np.unravel_index(different[0], a.shape))
    return (
        f"{len(different)} of {a.size} elements, {list(place)}: {a[place]!s} → {b[place]!s}, "
        f"at most {_size(a, b) or 0.0:.3g} apart"
    )


def _bits(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array as whole numbers of its bits, flat: NaN equals itself, and 0 is not -0."""
    flat = np.ascontiguousarray(array).reshape(-1)
    return flat.view(f"u{flat.dtype.itemsize}")


def _short(value: Value) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _patterns(names: set[str]) -> list[str]:
    """Return names with * for the numbers in them, each once, with its count."""
    counts: dict[str, int] = {}
    for name in sorted(names):
        pattern = re.sub(r"(?<![^.])\d+(?![^.])", "*", name)
        counts[pattern] = counts.get(pattern, 0) + 1
    return [f"{pattern} ({count}×)" if count > 1 else pattern for pattern, count in counts.items()]
