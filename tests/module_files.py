"""Import Python files that belong to no package."""

import importlib.util
from pathlib import Path
from types import ModuleType


def module_from(path: Path) -> ModuleType:
    """Run a Python file as a module of its own, registered nowhere; return it."""
    spec = importlib.util.spec_from_file_location(f"file_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
