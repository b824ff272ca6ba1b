"""Check values in the JSON files of a run when they are read: a damaged file is named, with the wrong value."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sigmasplat.data.component import APART, LOST, RELOCALISED, TRACKED
from sigmasplat.errors import RunError

Test = Callable[[Any], bool]
MOST_NUMBER = 1e15
REMEDY = "restore the file, or run it again"


def is_number(value: Any) -> bool:
    """Return whether a value is a number of a usable size."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MOST_NUMBER


def is_whole(value: Any) -> bool:
    """Return whether a value is a whole number of a usable size."""
    return is_number(value) and isinstance(value, int)


def _number_or_null(value: Any) -> bool:
    return value is None or is_number(value)


def are_numbers(value: Any) -> bool:
    """Return whether a value is an object of numbers, null and flags."""
    return isinstance(value, dict) and all(_number_or_null(item) or isinstance(item, bool) for item in value.values())


def _pose(value: Any) -> bool:
    rows = isinstance(value, list) and len(value) == 4 and all(isinstance(row, list) and len(row) == 4 for row in value)
    return rows and all(is_number(item) for row in value for item in row)


def _vector(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(is_number(item) for item in value)


def _direction(value: Any) -> bool:
    return _vector(value) and math.hypot(*value) > 0.0


def _seconds(value: Any) -> bool:
    return isinstance(value, dict) and all(is_number(item) for item in value.values())


def _texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def _records(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, dict) for item in value)


def is_kind(*kinds: type) -> Test:
    """Return a test for instances of some types."""
    return lambda value: isinstance(value, kinds)


LOG: Mapping[str, Test] = {
    "index": lambda value: is_whole(value) and value >= 0, "timestamp_s": is_number, "is_keyframe": is_kind(bool),
    "lost": is_kind(bool), "state": lambda value: value in (TRACKED, RELOCALISED, LOST, APART), "component": is_whole,
    "p_off": _number_or_null, "splats": is_whole, "submap": is_whole, "tracking": are_numbers, "seconds": _seconds,
    "T_world_camera": _pose, "loops": _records, "specific_force_m_s2": _vector,
}  # fmt: skip
"""Values of a line of log.jsonl."""
FACTS: Mapping[str, Test] = {
    "source": is_kind(str), "source_path": is_kind(str), "status": is_kind(str), "skipped": _texts,
    "wall_s": _number_or_null, "finish_s": _number_or_null, "final_steps": _number_or_null, "machine": is_kind(dict),
    "onto": is_kind(dict), "camera": is_kind(dict), "source_frames": is_whole, "depth_units_per_metre": _number_or_null,
    "isa": is_kind(str, type(None)), "scene_scale": _number_or_null, "depth_noise_per_m": _number_or_null,
    "sensor": is_kind(str, type(None)), "predicted_depth": is_kind(bool), "depth_model": is_kind(dict),
    "up_world": _direction,
}  # fmt: skip
"""Values of run.json that commands use."""
STATE_FIELDS: Mapping[str, Test] = {"index": is_whole, "wall_s": is_number, "submaps": is_whole}
"""Values of a saved state beside those of `Slam`."""


def check_fields(values: Any, tests: Mapping[str, Test], required: tuple[str, ...], where: object) -> dict[str, Any]:
    """Return an object with the required fields. Raises RunError naming `where` if a field is missing or mistyped."""
    if not isinstance(values, dict):
        raise RunError(f"{where}: {_short(values)} is not an object; {REMEDY}")
    for name in required:
        if name not in values:
            raise RunError(f"{where}: field {name!r} is missing; {REMEDY}")
    for name, value in values.items():
        if name in tests and not tests[name](value):
            raise RunError(f"{where}: field {name!r} has the value {_short(value)}; {REMEDY}")
    checked: dict[str, Any] = values
    return checked


def check_profile(values: Any, path: Path) -> dict[str, float]:
    """Return the seconds of each stage of a run. Raises RunError naming the file if one is not a number."""
    return check_fields(values, dict.fromkeys(values, is_number) if isinstance(values, dict) else {}, (), path)


class Record(dict[str, Any]):
    """A line of log.jsonl; a missing field raises RunError. Logs of older versions lack some fields."""

    def __init__(self, values: Mapping[str, Any], where: str) -> None:
        super().__init__(values)
        self.where = where

    def __missing__(self, name: str) -> Any:
        raise RunError(f"{self.where}: field {name!r} is missing; {REMEDY}")


def check_log(records: list[Any], path: Path) -> list[dict[str, Any]]:
    """Return the records of a log. Raises RunError naming the line of a wrong value."""
    places = (f"{path}:{number}" for number in range(1, len(records) + 1))
    return [Record(check_fields(record, LOG, (), where), where) for record, where in zip(records, places, strict=True)]


def frame_seconds(record: Mapping[str, Any]) -> float:
    """Return the time of one frame: its `total`, or the sum of its stages."""
    stages: dict[str, float] = record.get("seconds") or {}
    return float(stages.get("total", sum(stages.values())))


def _short(value: Any) -> str:
    if isinstance(value, int) and not isinstance(value, bool) and not math.log10(abs(value) + 1) < 60:
        return "a very large number"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]} …"
