"""Check the tensors of a checkpoint when it is read: types, shapes, ranges, and that all parts fit to each other."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from sigmasplat.errors import RunError
from sigmasplat.run_folder.run_values import MOST_NUMBER, REMEDY

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
