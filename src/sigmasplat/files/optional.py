"""Import packages that only some formats need."""

import importlib
from typing import Any

from sigmasplat.env import install_extra
from sigmasplat.errors import SourceError


def import_optional(module: str, extra: str, what: str) -> Any:
    """Import a module. Raises SourceError naming what needs it and the extra that installs it."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise SourceError(f"{what} needs {module} ({error}): {install_extra(extra)}") from error
    except ImportError as error:
        raise SourceError(
            f"{what} needs {module}, which is installed but does not load ({error}); install the missing system library"
        ) from error
