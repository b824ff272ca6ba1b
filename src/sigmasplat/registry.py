"""Plug-ins: rows of six kinds. The package brings some; other packages and single files add more.

A module registers what it adds as `PLUGIN`, one row or a tuple of rows. It is found in three ways:

- a module in `plugins/sources` (a data set), `plugins/outputs`, `plugins/presets` or `plugins/cuda` of this package;
- an entry point of the group `sigmasplat.plugins` of an installed package, which names the module;
- `--plugin FILE.py` before or after a command, which is the same as naming the file in SIGMASPLAT_PLUGINS.
"""

import os
import pkgutil
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib import import_module, metadata
from importlib.util import module_from_spec, spec_from_file_location
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from sigmasplat.errors import ConfigError, nearest

if TYPE_CHECKING:
    from types import ModuleType

    import numpy as np
    import torch
    from numpy.typing import NDArray

    from sigmasplat.config import Config, InputConfig, RenderConfig
    from sigmasplat.data.camera import Camera
    from sigmasplat.data.frame import Frame
    from sigmasplat.fit.interface import DeviceFits
    from sigmasplat.input.source import Source
    from sigmasplat.render.view import View

GROUP, FILES = "sigmasplat.plugins", "SIGMASPLAT_PLUGINS"
"""The group of entry points, and the environment variable with files of plug-ins, separated as in PATH."""


@dataclass(frozen=True)
class SourceFormat:
    """One layout of a recording on disk.

    recognises(path): whether the path has this layout, from its content only; looked_for: names the files that identify
    it, for messages; open(path, settings): builds the source of all its frames; priority: layouts of higher priority
    are asked first, so that a special one comes before a general one (above 0: other layouts recognise the same files;
    below 0: a guess); sensor: the depth sensor of all its recordings (`config.input`), None if it varies.
    """

    name: str
    looked_for: str
    recognises: "Callable[[str], bool]"
    open: "Callable[[str, InputConfig], Source]"
    priority: int = 0
    sensor: str | None = None


@dataclass(frozen=True)
class Mask:
    """Pixels that SLAM ignores. ignored(frame): returns them [H, W]; `input.filters` names the mask."""

    name: str
    ignored: "Callable[[Frame], NDArray[np.bool_]]"


@dataclass(frozen=True)
class DepthFilter:
    """Another depth image. filtered(frame): returns it [H, W], metres, 0 = no reading; `input.filters` names it."""

    name: str
    filtered: "Callable[[Frame], NDArray[np.float32]]"


@dataclass(frozen=True)
class Output:
    """One format of `sigmasplat export`: the name for --format, the endings that select it, a line of help, its writer.

    An ending selects the first row that has it. Without --out, an export gets the row's first ending. `write(source,
    target, …)` writes the target, a file or folder that does not exist or may be replaced, and returns a short
    description of its content. Its keyword-only parameters are the options of the command line that the format accepts.
    """

    name: str
    endings: tuple[str, ...]
    help: str
    write: Callable[..., str]

    @property
    def options(self) -> tuple[str, ...]:
        """Return the names of the writer's options."""
        return tuple(p.name for p in signature(self.write).parameters.values() if p.kind is Parameter.KEYWORD_ONLY)

    def accepts(self, option: str) -> bool:
        """Return whether an option of the command line can be used with this format."""
        return option in self.options


@dataclass(frozen=True)
class Backend:
    """A device that renders and fits; `backend` and SIGMASPLAT_BACKEND name it.

    operators(): the module with its `project` and `blend`; view(camera, options, variance): a view (`render/view.py`);
    fits(): what it offers to the fits; device(): the device that holds its tensors, None = host memory.
    """

    name: str
    operators: "Callable[[], ModuleType]"
    view: "Callable[[Camera, RenderConfig, bool], View]"
    fits: "Callable[[], DeviceFits]"
    device: "Callable[[], torch.device] | None" = None


@dataclass(frozen=True)
class Preset:
    """Settings with a name. make(): returns them; scenes(): lists the scenes if settings differ by scene. One of them
    then follows the name, and make(scene) returns its settings."""

    name: str
    make: "Callable[..., Config]"
    scenes: "Callable[[], Collection[str]] | None" = None


Row = SourceFormat | Mask | DepthFilter | Output | Backend | Preset
Kind = TypeVar("Kind", SourceFormat, Mask, DepthFilter, Output, Backend, Preset)
BUILT_IN: dict[type, str] = {
    SourceFormat: "sources", Output: "outputs.formats", Preset: "presets", Backend: "cuda.backend", Mask: "",
    DepthFilter: "",
}  # fmt: skip
"""Where in `sigmasplat.plugins` the rows of each kind are: in a module, or in all modules of a package."""
WORDS = {
    SourceFormat: "format", Mask: "mask", DepthFilter: "depth filter", Output: "format", Backend: "backend",
    Preset: "preset",
}  # fmt: skip


@cache
def rows(kind: type[Kind]) -> tuple[Kind, ...]:
    """Return all rows of a kind: those of this package, of other packages, of files.

    Raises ConfigError if a plug-in cannot be imported, has no rows, or has a name that another row has.
    """
    found = {row.name: row for row in _built_in(BUILT_IN[kind]) if isinstance(row, kind)}
    for where, row in _added():
        if isinstance(row, kind):
            if row.name in found:
                raise ConfigError(f"{where}: there is a {WORDS[kind]} {row.name!r} already; give it another name")
            found[row.name] = row
    return tuple(found.values())


def named(kinds: Sequence[type], name: str) -> Any:
    """Return the row with a name, of one of some kinds. Raises ConfigError if there is none."""
    known = {row.name: row for kind in kinds for row in rows(kind)}
    if name not in known:
        words = " or ".join(WORDS[kind] for kind in kinds)
        listed = f"known: {', '.join(known)}" if known else "none is known"
        raise ConfigError(
            f"no {words} {name!r}{nearest(name, known)} ({listed}); add --plugin FILE.py, or install the package that "
            "has it"
        )
    return known[name]


def use_files(paths: Sequence[str]) -> None:
    """Use files of plug-ins, in this process and in those that it starts. Raises ConfigError if one does not exist."""
    for path in paths:
        if not Path(path).is_file():
            raise ConfigError(f"--plugin {path}: no such file; give a Python file that defines PLUGIN")
    given = [entry for entry in os.environ.get(FILES, "").split(os.pathsep) if entry]
    os.environ[FILES] = os.pathsep.join(dict.fromkeys([*given, *(str(Path(path).resolve()) for path in paths)]))
    _added.cache_clear()
    rows.cache_clear()


def _built_in(name: str) -> Iterator[Row]:
    if not name:
        return
    module = import_module(f"sigmasplat.plugins.{name}")
    names = sorted(inner.name for inner in pkgutil.iter_modules(getattr(module, "__path__", ())) if not inner.ispkg)
    for found in (module, *(import_module(f"{module.__name__}.{inner}") for inner in names)):
        yield from _rows_of(found, found.__name__) if hasattr(found, "PLUGIN") else ()


@cache
def _added() -> tuple[tuple[str, Row], ...]:
    """Return the rows of other packages and of files, each with its origin."""
    found: list[tuple[str, Row]] = []
    for entry in sorted(metadata.entry_points(group=GROUP), key=lambda entry: entry.name):
        where = f"plug-in {entry.value}"
        found += [(where, row) for row in _rows_of(_loaded(where, entry.load), where)]
    for path in filter(None, os.environ.get(FILES, "").split(os.pathsep)):
        found += [(path, row) for row in _rows_of(_loaded(path, partial(_module_of, path)), path)]
    return tuple(found)


def _loaded(where: str, load: Callable[[], Any]) -> Any:
    try:
        return load()
    except Exception as problem:
        reason = f"{type(problem).__name__}: {problem}"
        raise ConfigError(f"{where} cannot be imported ({reason}); mend it or remove it") from problem


def _module_of(path: str) -> "ModuleType":
    name = f"sigmasplat_plugin_{Path(path).stem}"
    spec = spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigError("not a Python file")
    sys.modules[name] = module = module_from_spec(spec)  # dataclasses look up their module there
    spec.loader.exec_module(module)
    return module


def _rows_of(module: Any, where: str) -> Sequence[Row]:
    """Return the rows that a module registers. Raises ConfigError if it has none, or something else among them."""
    plugin = getattr(module, "PLUGIN", None)
    found = plugin if isinstance(plugin, tuple) else (plugin,)
    if not found or not all(isinstance(row, Row) for row in found):
        raise ConfigError(
            f"{where} registers no row: PLUGIN is {plugin!r}; set PLUGIN to a row of sigmasplat.api (SourceFormat, "
            "Mask, DepthFilter, Output, Backend, Preset), or to a tuple of rows"
        )
    return found
