"""Open a sequence whatever its format: ask each format of this folder whether it knows the path."""

import importlib
import pkgutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

from sigmasplat.config import InputConfig
from sigmasplat.config.text import nearest
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.sources.base import Source, Subset

PACKED = (".bag", ".mcap", ".db3", ".r3d")
"""Endings of files that may be whole sequences; only for the message that names those of a folder."""


@dataclass(frozen=True)
class Format:
    """One way a sequence can be laid out. A module of this folder that defines `FORMAT` is found by itself.

    recognises(path): looks at the content only; looked_for: what it looked for, for the error message;
    open(path, settings): builds the source of all its frames; priority: formats of a higher one are asked first, so
    that what is special wins over what is general (above 0: more than its lists; below: a guess for want of better).
    """

    name: str
    looked_for: str
    recognises: Callable[[str], bool]
    open: Callable[[str, InputConfig], Source]
    priority: int = 0


@cache
def formats() -> tuple[Format, ...]:
    """Find the formats: every module directly in `sigmasplat.sources` that defines FORMAT, by priority and name."""
    names = sorted(module.name for module in pkgutil.iter_modules(sys.modules[__package__].__path__) if not module.ispkg)
    modules = [importlib.import_module(f"sigmasplat.sources.{name}") for name in names]
    found = [module.FORMAT for module in modules if hasattr(module, "FORMAT")]
    return tuple(sorted(found, key=lambda known: -known.priority))


def open_source(path: str | Path, settings: InputConfig | None = None, **changes: Any) -> Source:
    """Open a recorded or synthetic sequence, its format guessed from what lies at `path`.

    `path` is a folder or file, or "synthetic" with options as in "synthetic:frames=200,seed=1,noise=1". Which frames
    are taken, and what is done to them, say the settings; any of them may be given by name: stride=2, limit=100.
    Raises SourceError if there is nothing at the path, no format knows it, or what is there cannot be used;
    ConfigError on a setting that is none.
    """
    asked = changed(settings or InputConfig(), changes)
    source = format_of(path).open(str(path), asked)
    part = asked.stride > 1 or asked.limit or asked.start_s or asked.end_s
    return Subset(source, asked) if part and not source.live else source


def format_of(path: str | Path) -> Format:
    """Return the first format that knows what lies at the path. Raises SourceError if none does."""
    known = _knowing(path)
    if known is None:
        raise SourceError(_nothing_fits(Path(path)))
    return known


def _knowing(path: str | Path) -> Format | None:
    return next((known for known in formats() if known.recognises(str(path))), None)


def changed(settings: InputConfig, changes: Mapping[str, Any]) -> InputConfig:
    """Return the settings with some given by name. Raises ConfigError on an unknown name."""
    known = [field.name for field in fields(InputConfig)]
    for name in changes:
        if name not in known:
            raise ConfigError(f"unknown setting input.{name}{nearest(name, known)}; there are {', '.join(known)}")
    return replace(settings, **changes)


def _nothing_fits(path: Path) -> str:
    if not path.exists():
        return (
            f"no such folder or file: {path}; give a recording, or 'synthetic' for the built-in room, "
            "or 'realsense' for the camera"
        )
    wanted = "; ".join(f"{f.name}: {f.looked_for}" for f in formats())
    if not path.is_dir():
        return f"{path} is a file of unknown format; give the folder that holds the sequence (looked for {wanted})"
    entries = sorted(path.iterdir())
    likely = (entry for entry in entries if entry.is_dir() or entry.suffix in PACKED)
    inner = [(entry.name, known.name) for entry in likely if (known := _knowing(entry))]
    if inner:
        names = ", ".join(f"{name} ({known})" for name, known in inner[:4]) + ", …" * (len(inner) > 4)
        return f"{path} holds sequences: {names}; give the path of one of them, as {path / inner[0][0]}"
    found = [entry.name + "/" * entry.is_dir() for entry in entries]
    listing = ", ".join(found[:8]) + (f", … {len(found)} entries" if len(found) > 8 else "") or "an empty folder"
    return f"unknown format: {path} (looked for {wanted}; found {listing}); docs/data.md shows the layouts"
