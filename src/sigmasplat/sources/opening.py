"""Open a sequence whatever its format: ask each format of this folder whether it knows the path."""

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import sigmasplat.sources
from sigmasplat.errors import SourceError
from sigmasplat.sources.base import Source, Subset


@dataclass(frozen=True)
class Format:
    """One way a sequence can be laid out. A module of this folder that defines `FORMAT` is found by itself.

    recognises(path): looks at the content only; looked_for: what it looked for, for the error message;
    open(path, strict): builds the source.
    """

    name: str
    looked_for: str
    recognises: Callable[[str], bool]
    open: Callable[[str, bool], Source]


@cache
def formats() -> tuple[Format, ...]:
    """Find the formats: every module directly in `sigmasplat.sources` that defines FORMAT, in order of name."""
    names = sorted(module.name for module in pkgutil.iter_modules(sigmasplat.sources.__path__) if not module.ispkg)
    modules = [importlib.import_module(f"sigmasplat.sources.{name}") for name in names]
    return tuple(module.FORMAT for module in modules if hasattr(module, "FORMAT"))


def open_source(path: str | Path, strict: bool = False, stride: int = 1, limit: int | None = None) -> Source:
    """Open a recorded or synthetic sequence, its format guessed from what lies at `path`.

    `path` is a folder, or "synthetic" with options as in "synthetic:frames=200,seed=1,noise=1". `strict` makes an
    unreadable image an error instead of a skip; every `stride`-th frame is taken, at most `limit` of them.
    Raises SourceError if there is nothing at the path, no format knows it, or what is there cannot be used.
    """
    text = str(path)
    for format_ in formats():
        if format_.recognises(text):
            source = format_.open(text, strict)
            return source if stride == 1 and limit is None else Subset(source, stride, limit)
    raise SourceError(_nothing_fits(Path(text)))


def _nothing_fits(path: Path) -> str:
    if not path.exists():
        return f"no such folder: {path}; give the folder of a sequence, or 'synthetic' for the built-in room"
    if not path.is_dir():
        return f"{path} is a file; give the folder that holds the sequence"
    wanted = "; ".join(f"{f.name}: {f.looked_for}" for f in formats())
    found = sorted(entry.name + "/" * entry.is_dir() for entry in path.iterdir())
    listing = ", ".join(found[:8]) + (f", … {len(found)} entries" if len(found) > 8 else "") or "an empty folder"
    return f"unknown format: {path} (looked for {wanted}; found {listing})"
