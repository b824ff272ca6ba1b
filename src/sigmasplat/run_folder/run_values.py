"""Check the JSON files and the checkpoint of a run when they are read: a damaged file is named, with what is wrong."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sigmasplat.data.trajectory import APART, LOST, RELOCALISED, TRACKED
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


POSE, NUMBER = (4, 4), ()
FINITE: Mapping[str, tuple[str, tuple[int, ...]]] = {
    "timestamps_s": ("frames", NUMBER), "T_world_camera": ("frames", POSE), "T_world_camera_odometry": ("frames", POSE),
    "T_submap_camera": ("frames", POSE), "T_keyframe_camera": ("frames", POSE), "exposure": ("frames", (3, 2)),
    "T_world_submap": ("submaps", POSE),
    "T_world_keyframe": ("places", POSE), "T_submap_keyframe": ("places", POSE),
    "hop_T_camera_before": ("places", POSE), "hop_bias": ("places", (6,)),
    "edge_T_a_b": ("edges", POSE), "edge_information": ("edges", (6, 6)), "edge_drift": ("edges", (6, 6)),
}  # fmt: skip
"""Tensors of finite numbers: what their rows are, and the shape of a row. A place is a keyframe of a submap."""
UNKNOWN: Mapping[str, tuple[str, tuple[int, ...]]] = {"hop_covariance": ("places", (6, 6))}
"""Tensors in which inf means that a number is not known."""
WHOLE: Mapping[str, tuple[str, tuple[int, ...], str]] = {
    "keyframes": ("keyframes", NUMBER, "frames"), "frame_submap": ("frames", NUMBER, "submaps"),
    "frame_keyframe": ("frames", NUMBER, "places"), "keyframe_submap": ("places", NUMBER, "submaps"),
    "submap_component": ("submaps", NUMBER, "submaps"), "edge_submaps": ("edges", (2,), "submaps"),
    "edge_keyframes": ("edges", (2,), "places"),
}  # fmt: skip
"""Tensors of row numbers: what their rows are, the shape of a row, and what they count."""
FLAGS: Mapping[str, tuple[str, tuple[int, ...]]] = {"edge_is_loop": ("edges", NUMBER)}


class Tensors(dict[str, Tensor]):
    """The tensors of a file by name; a missing one raises RunError."""

    def __init__(self, found: Mapping[str, Tensor], path: Path) -> None:
        super().__init__(found)
        self.path = path

    def __missing__(self, name: str) -> Tensor:
        raise RunError(f"{self.path}: tensor {name!r} is missing; {REMEDY}")


def check_checkpoint(found: Mapping[str, Tensor], path: Path) -> Tensors:
    """Return the tensors of a checkpoint. Raises RunError if one has a wrong type or shape, is not finite, counts rows
    that do not exist, or does not fit to the others. Versions before this one wrote fewer tensors."""
    lengths = _checked_shapes(found, path)
    for name, (_, _, counted) in WHOLE.items():
        values, most = found.get(name), lengths.get(counted)
        if values is None or most is None or not values.numel():
            continue
        low, high = int(values.min()), int(values.max())
        if low < 0 or high >= most:
            found_number = low if low < 0 else high
            raise RunError(
                f"{path}: tensor {name!r} has the number {found_number}, but there are {most} {counted}; {REMEDY}"
            )
    _check_places(found, path)
    return Tensors(found, path)


def _checked_shapes(found: Mapping[str, Tensor], path: Path) -> dict[str, int]:
    """Return how many frames, keyframes, places, submaps and edges there are; all tensors agree on it."""
    lengths, first = dict[str, int](), dict[str, str]()
    kinds = {name: (rows, row) for name, (rows, row, _) in WHOLE.items()}
    for name, (rows, row) in {**FINITE, **UNKNOWN, **kinds, **FLAGS}.items():
        if (tensor := found.get(name)) is None:
            continue
        if not _has_type(name, tensor) or tensor.ndim != 1 + len(row) or tuple(tensor.shape[1:]) != row:
            raise RunError(f"{path}: tensor {name!r} is {tensor.dtype} {list(tensor.shape)}; {REMEDY}")
        if name in FINITE and not _is_finite(tensor):
            raise RunError(f"{path}: tensor {name!r} has nan, inf or very large numbers; {REMEDY}")
        if lengths.setdefault(rows, len(tensor)) != len(tensor):
            wrong = f"{len(tensor)} rows, and {first[rows]!r} has {lengths[rows]}"
            raise RunError(f"{path}: tensor {name!r} has {wrong}; {REMEDY}")
        first.setdefault(rows, name)
    return lengths


def _has_type(name: str, tensor: Tensor) -> bool:
    if name in FLAGS:
        return tensor.dtype == torch.bool
    if name in WHOLE:
        return tensor.dtype in (torch.int32, torch.int64)
    return tensor.is_floating_point()


def _is_finite(tensor: Tensor) -> bool:
    return bool(torch.isfinite(tensor).all()) and (not tensor.numel() or float(tensor.abs().max()) <= MOST_NUMBER)


def _check_places(found: Mapping[str, Tensor], path: Path) -> None:
    """Raise RunError unless the keyframes are in the order of their submaps, and each frame's keyframe is among those
    of its submap."""
    if not {"keyframe_submap", "frame_submap", "frame_keyframe", "T_world_submap"} <= set(found):
        return
    submaps = found["keyframe_submap"]
    if bool((submaps[1:] < submaps[:-1]).any()):
        raise RunError(f"{path}: tensor 'keyframe_submap' is not in order; {REMEDY}")
    counts = torch.bincount(submaps, minlength=len(found["T_world_submap"]))
    if bool((found["frame_keyframe"] >= counts[found["frame_submap"]]).any()):
        raise RunError(f"{path}: tensor 'frame_keyframe' counts keyframes that its submap does not have; {REMEDY}")
    if "edge_keyframes" in found and bool((found["edge_keyframes"] >= counts[found["edge_submaps"]]).any()):
        raise RunError(f"{path}: tensor 'edge_keyframes' counts keyframes that its submap does not have; {REMEDY}")
