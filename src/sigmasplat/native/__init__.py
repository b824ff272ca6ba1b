"""The compiled kernels: `_core`, built from the sources in this folder. It takes arrays and does not link torch."""

from typing import Any


def kernels() -> Any:
    """Return the module of compiled kernels, or None if it is not built."""
    try:
        from sigmasplat.native import _core
    except ImportError:
        return None
    return _core
