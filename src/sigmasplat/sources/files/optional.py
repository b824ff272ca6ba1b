"""Load packages that only some formats need."""

import importlib
from typing import Any

from sigmasplat.env import install_extra
from sigmasplat.errors import SourceError


def import_optional(module: str, extra: str, what: str) -> Any:
    """Import a module. Raises SourceError that says for what it is needed and which extra of ours brings it."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise SourceError(f"{what} needs {module} ({error}): {install_extra(extra)}") from error
    except ImportError as error:
        raise SourceError(
            f"{what} needs {module}, which is there but does not load ({error}); install the system library it names"
        ) from error
