"""Check the types of the objects in a saved state, so that a damaged state is refused before a run continues it."""

import dataclasses
import types
import typing
from functools import cache
from typing import Any

import numpy as np
import torch

from sigmasplat.data.column import Column

PLAIN = (bool, int, str, list, tuple, dict, set, np.ndarray, torch.Tensor)


@cache
def allowed_types(owner: type) -> dict[str, tuple[type, ...]]:
    """Return the types that each field of a dataclass or named tuple may have; fields of any type are left out."""
    try:
        hints = typing.get_type_hints(owner)
    except (NameError, TypeError):  # a hint that exists for type checkers only
        return {}
    found = {name: _runtime_types(hint) for name, hint in hints.items()}
    return {name: kinds for name, kinds in found.items() if kinds}


def wrong_field(owner: type, values: dict[str, Any]) -> str | None:
    """Name a field whose value has another type than the class says, or a pose or map that is not finite; else None."""
    allowed = allowed_types(owner)
    for name, value in values.items():
        kinds = allowed.get(name)
        if kinds and not isinstance(value, kinds):
            return f"{owner.__name__}.{name} is {type(value).__name__}"
        if isinstance(value, Column) and name == "rows" and hasattr(owner, "POSE_COLUMNS"):
            numbers: Any = value.used[:, owner.POSE_COLUMNS]
        else:
            numbers = value if name.startswith("T_") or name == "params" else None
        if not is_finite(numbers):
            return f"{owner.__name__}.{name} has nan or inf"
    return None


def is_finite(value: Any) -> bool:
    """Return whether an array or tensor has neither nan nor inf; other values are finite."""
    if isinstance(value, torch.Tensor):
        return not value.is_floating_point() or bool(torch.isfinite(value).all())
    return not isinstance(value, np.ndarray) or value.dtype.kind != "f" or bool(np.isfinite(value).all())


def _runtime_types(hint: Any) -> tuple[type, ...]:
    """Return the classes of a type hint; () if any value may have it."""
    origin = typing.get_origin(hint)
    if hint is None or hint is type(None):
        return (type(None),)
    if origin in (typing.Union, types.UnionType):
        parts = [_runtime_types(part) for part in typing.get_args(hint)]
        return tuple(kind for part in parts for kind in part) if all(parts) else ()
    if origin is typing.Literal:
        return tuple({type(value) for value in typing.get_args(hint)})
    if hint is float or origin is float:
        return (float, int)
    kind = origin if isinstance(origin, type) else hint
    if not isinstance(kind, type) or kind is object or getattr(kind, "_is_protocol", False):
        return ()
    return (kind,) if kind in PLAIN or dataclasses.is_dataclass(kind) else ()
