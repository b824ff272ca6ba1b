"""Check the types of settings that are read from JSON."""

import sys
from typing import Any, Literal, get_args, get_origin, get_type_hints

from sigmasplat.errors import ConfigError


def of_types(section: type, values: dict[str, Any], prefix: str) -> dict[str, Any]:
    """Return the values of a section. Raises ConfigError naming one that does not have the type of its setting."""
    kinds = get_type_hints(section)
    for name, value in values.items():
        kind = kinds[name]
        if get_origin(kind) is Literal:
            fits = value in get_args(kind)
        elif kind is float:
            fits = isinstance(value, float | int) and not isinstance(value, bool) and abs(value) < sys.float_info.max
        elif kind in (bool, int, str):
            fits = type(value) is kind
        else:
            fits = True
        if not fits:
            raise ConfigError(f"setting '{prefix}{name}' has a value of the wrong type: {str(value)[:60]!r}")
    return values
