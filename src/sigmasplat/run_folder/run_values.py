"""Check the JSON files and the checkpoint of a run when they are read: a damaged file is named, with what is wrong."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sigmasplat.data.trajectory import APART, LOST, RELOCALISED, TRACKED
from sigmasplat.errors import RunError

MOST_NUMBER = 1e15
REMEDY = "restore the file, or run it again"
Kind = Any
"""What a value may be, see `fits`."""


def fits(value: Any, kind: Kind) -> bool:
    """Return whether a value from JSON is of a kind: None, a class, [kind of the items], {"": kind of the values}, a
    tuple of kinds, or a test. Numbers have a usable size, and are not bool."""
    if isinstance(kind, tuple):
        return any(fits(value, one) for one in kind)
    if isinstance(kind, list):
        return isinstance(value, list) and all(fits(item, kind[0]) for item in value)
    if isinstance(kind, dict):
        return isinstance(value, dict) and all(fits(item, kind[""]) for item in value.values())
    if kind is int or kind is float:
        number = isinstance(value, int | kind) and not isinstance(value, bool)
        return number and abs(value) <= MOST_NUMBER
    if isinstance(kind, type):
        return isinstance(value, kind)
    return value is None if kind is None else bool(kind(value))


def _vector(value: Any) -> bool:
    return fits(value, [float]) and len(value) == 3


def _pose(value: Any) -> bool:
    return fits(value, [[float]]) and list(map(len, value)) == [4] * 4


LOG: Mapping[str, Kind] = {
    "index": lambda value: fits(value, int) and value >= 0, "timestamp_s": float, "is_keyframe": bool, "lost": bool,
    "state": lambda value: value in (TRACKED, RELOCALISED, LOST, APART), "component": int, "p_off": (float, None),
    "splats": int, "submap": int, "tracking": {"": (float, None, bool)}, "seconds": {"": float},
    "T_world_camera": _pose, "loops": [dict], "specific_force_m_s2": _vector,
}  # fmt: skip
"""Values of a line of log.jsonl."""
FACTS: Mapping[str, Kind] = {
    "source": str, "source_path": str, "status": str, "skipped": [str], "wall_s": (float, None),
    "finish_s": (float, None), "final_steps": (float, None), "machine": dict, "onto": dict, "camera": dict,
    "source_frames": int, "depth_units_per_metre": (float, None), "isa": (str, None), "scene_scale": (float, None),
    "depth_noise_per_m": (float, None), "sensor": (str, None), "predicted_depth": bool,
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


def check_profile(values: Any, path: Path) -> dict[str, float]:
    """Return the seconds of each stage of a run. Raises RunError naming the file if one is not a number."""
    return check_fields(values, dict.fromkeys(values, float) if isinstance(values, dict) else {}, (), path)


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


POSE, FLOAT, INT, BOOL = (4, 4), "float", "int", "bool"
TENSORS: Mapping[str, tuple[str, tuple[int, ...], str]] = {
    "timestamps_s": ("frames", (), FLOAT), "T_world_camera": ("frames", POSE, FLOAT),
    "T_world_camera_odometry": ("frames", POSE, FLOAT), "T_submap_camera": ("frames", POSE, FLOAT),
    "T_keyframe_camera": ("frames", POSE, FLOAT), "exposure": ("frames", (3, 2), FLOAT),
    "T_world_submap": ("submaps", POSE, FLOAT), "T_world_keyframe": ("places", POSE, FLOAT),
    "T_submap_keyframe": ("places", POSE, FLOAT), "hop_T_camera_before": ("places", POSE, FLOAT),
    "hop_bias": ("places", (6,), FLOAT), "hop_covariance": ("places", (6, 6), FLOAT),
    "edge_T_a_b": ("edges", POSE, FLOAT), "edge_information": ("edges", (6, 6), FLOAT),
    "edge_drift": ("edges", (6, 6), FLOAT), "edge_is_loop": ("edges", (), BOOL), "keyframes": ("keyframes", (), INT),
    "frame_submap": ("frames", (), INT), "frame_keyframe": ("frames", (), INT), "keyframe_submap": ("places", (), INT),
    "submap_component": ("submaps", (), INT), "edge_submaps": ("edges", (2,), INT),
    "edge_keyframes": ("edges", (2,), INT), "graph_node": ("places", (), INT),
    "graph_T_world_node": ("nodes", POSE, FLOAT), "graph_ends": ("alignments", (2,), INT),
    "graph_T_a_b": ("alignments", POSE, FLOAT), "graph_information": ("alignments", (6, 6), FLOAT),
    "graph_shared": ("alignments", (6, 9), FLOAT), "graph_fixed": ("graphs", (), INT),
}  # fmt: skip
"""What the rows of each tensor are, the shape of a row, and the type. A place is a keyframe of a submap."""
MAY_BE_UNKNOWN = {"hop_covariance"}
"""Tensors in which inf means that a number is not known; the others are finite."""
MAY_BE_NONE = {"graph_node"}
"""Tensors of row numbers in which −1 means none."""
COUNTED = {
    "keyframes": "frames", "frame_submap": "submaps", "frame_keyframe": "places", "keyframe_submap": "submaps",
    "submap_component": "submaps", "edge_submaps": "submaps", "edge_keyframes": "places",
    "graph_node": "nodes", "graph_ends": "nodes", "graph_fixed": "nodes",
}  # fmt: skip
"""What the row numbers in a tensor count."""


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
    for name, counted in COUNTED.items():
        values, most = found.get(name), lengths.get(counted)
        if values is None or most is None or not values.numel():
            continue
        low, high = int(values.min()), int(values.max())
        least = -1 if name in MAY_BE_NONE else 0
        if low < least or high >= most:
            found_number = low if low < least else high
            raise RunError(
                f"{path}: tensor {name!r} has the number {found_number}, but there are {most} {counted}; {REMEDY}"
            )
    _check_places(found, path)
    return Tensors(found, path)


def _checked_shapes(found: Mapping[str, Tensor], path: Path) -> dict[str, int]:
    """Return how many frames, keyframes, places, submaps and edges there are; all tensors agree on it."""
    lengths, first = dict[str, int](), dict[str, str]()
    for name, (rows, row, kind) in TENSORS.items():
        if (tensor := found.get(name)) is None:
            continue
        if (
            not str(tensor.dtype).startswith(f"torch.{kind}")
            or tensor.ndim != 1 + len(row)
            or tuple(tensor.shape[1:]) != row
        ):
            raise RunError(f"{path}: tensor {name!r} is {tensor.dtype} {list(tensor.shape)}; {REMEDY}")
        if kind == FLOAT and name not in MAY_BE_UNKNOWN and not _is_finite(tensor):
            raise RunError(f"{path}: tensor {name!r} has nan, inf or very large numbers; {REMEDY}")
        if lengths.setdefault(rows, len(tensor)) != len(tensor):
            wrong = f"{len(tensor)} rows, and {first[rows]!r} has {lengths[rows]}"
            raise RunError(f"{path}: tensor {name!r} has {wrong}; {REMEDY}")
        first.setdefault(rows, name)
    return lengths


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
