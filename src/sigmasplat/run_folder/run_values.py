"""Check the JSON files of a run when they are read: a damaged file is named, with what is wrong."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin

from sigmasplat.data.trajectory import APART, LOST, RELOCALISED, TRACKED
from sigmasplat.errors import RunError

MOST_NUMBER = 1e15
REMEDY = "restore the file, or run it again"
Value = TypeVar("Value")
Kind = Any
"""What a value may be, see `fits`."""


def fits(value: Any, kind: Kind) -> bool:
    """Return whether a value from JSON or TOML is of a kind: a type, such as list[float] or str | None, or a
    test. Numbers have a usable size, and are not bool."""
    of: Any = get_origin(kind)
    parts = get_args(kind)
    if of is UnionType:
        return any(fits(value, one) for one in parts)
    if of in (list, Sequence):
        return isinstance(value, list | tuple) and all(fits(item, parts[0]) for item in value)
    if of in (dict, Mapping):
        return isinstance(value, dict) and all(fits(item, parts[1]) for item in value.values())
    if kind is int or kind is float:
        number = isinstance(value, int | kind) and not isinstance(value, bool)
        return number and abs(value) <= MOST_NUMBER
    if isinstance(kind, type):
        return isinstance(value, kind)
    return bool(kind(value))


def _vector(value: Any) -> bool:
    return fits(value, list[float]) and len(value) == 3


LOG: Mapping[str, Kind] = {
    "index": lambda value: fits(value, int) and value >= 0, "timestamp_s": float, "is_keyframe": bool, "lost": bool,
    "state": lambda value: value in (TRACKED, RELOCALISED, LOST, APART), "component": int, "p_off": float | None,
    "splats": int, "submap": int, "tracking": dict[str, float | bool | None], "seconds": dict[str, float],
    "T_world_camera": lambda value: fits(value, list[list[float]]) and list(map(len, value)) == [4] * 4,
    "loops": list[dict[str, object]], "diagnosis": str, "specific_force_m_s2": _vector,
}  # fmt: skip
"""Values of a line of log.jsonl."""
FACTS: Mapping[str, Kind] = {
    "source": str, "source_path": str, "status": str, "skipped": list[str], "wall_s": float | None,
    "finish_s": float | None, "final_steps": float | None, "machine": dict, "onto": dict, "camera": dict,
    "source_frames": int, "depth_units_per_metre": float | None, "isa": str | None, "scene_scale": float | None,
    "depth_noise_per_m": float | None, "sensor": str | None, "predicted_depth": bool, "checkpoint": str,
    "sensor_times": dict[str, float | list[float]],
    "up_world": lambda value: _vector(value) and math.hypot(*value) > 0.0,
}  # fmt: skip
"""Values of run.json that commands use."""


def check_fields(values: Any, kinds: Mapping[str, Kind], required: tuple[str, ...], where: object) -> dict[str, Any]:
    """Return an object with the required fields. Raises RunError naming `where` if a field is missing or mistyped."""
    if not isinstance(values, dict):
        raise RunError(f"{where}: {_short(values)} is not an object; {REMEDY}")
    for name in required:
        if name not in values:
            raise RunError(f"{where}: field {name!r} is missing; {REMEDY}")
    for name, value in values.items():
        if name in kinds and not fits(value, kinds[name]):
            raise RunError(f"{where}: field {name!r} has the value {_short(value)}; {REMEDY}")
    checked: dict[str, Any] = values
    return checked


class Named(dict[str, Value]):
    """Values by name: fields of a line of log.jsonl, or tensors of a file. A missing one raises RunError."""

    def __init__(self, values: Mapping[str, Value], where: object, what: str) -> None:
        super().__init__(values)
        self.where, self.what = where, what

    def __missing__(self, name: str) -> Value:
        raise RunError(f"{self.where}: {self.what} {name!r} is missing; {REMEDY}")


def check_log(records: list[Any], path: Path) -> list[dict[str, Any]]:
    """Return the records of a log. Raises RunError naming the line of a wrong value."""
    places = zip(records, (f"{path}:{number}" for number in range(1, len(records) + 1)), strict=True)
    return [Named(check_fields(record, LOG, (), where), where, "field") for record, where in places]


def frame_seconds(record: Mapping[str, Any]) -> float:
    """Return the time of one frame: its `total`, or the sum of its stages."""
    stages: dict[str, float] = record.get("seconds") or {}
    return float(stages.get("total", sum(stages.values())))


def _short(value: Any) -> str:
    if isinstance(value, int) and not isinstance(value, bool) and not math.log10(abs(value) + 1) < 60:
        return "a very large number"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]} …"
