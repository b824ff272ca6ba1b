"""Turn the exceptions of parsers into the errors of this package, each one line with place and remedy."""

import csv
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

from sigmasplat.errors import SigmaSplatError

DAMAGED: tuple[type[Exception], ...] = (
    OSError, ValueError, ArithmeticError, LookupError, TypeError, AttributeError, AssertionError, SyntaxError, EOFError,
    MemoryError, RuntimeError, StopIteration, tokenize.TokenError, csv.Error, struct.error, zlib.error,
    zipfile.BadZipFile, zipfile.LargeZipFile,
)  # fmt: skip
"""What parsers raise on damaged or hostile content: the standard library, numpy, Pillow, safetensors and others.
RuntimeError includes RecursionError and NotImplementedError, ValueError includes UnicodeDecodeError."""

MOST_CHARACTERS = 160


@contextmanager
def guarded(where: object, remedy: str, error: type[SigmaSplatError], what: str = "unreadable") -> Iterator[None]:
    """Raise `error` as "WHERE: WHAT (cause); REMEDY" for every exception of `DAMAGED` in the block.

    Errors of this package pass unchanged: they already name place and remedy.
    """
    try:
        yield
    except DAMAGED as problem:
        name = problem.filename if isinstance(problem, OSError) else None
        file = "" if name is None or str(name) in str(where) else f": {str(name)[-MOST_CHARACTERS:]}"
        raise error(f"{where}: {what} ({cause(problem)}{file}); {remedy}") from problem


def cause(problem: BaseException) -> str:
    """Describe an exception in one short line."""
    if isinstance(problem, MemoryError):
        return "it needs more memory than there is"
    if isinstance(problem, RecursionError):
        return "it is nested too deep"
    text = (isinstance(problem, OSError) and problem.strerror) or " ".join(str(problem).split())
    text = "".join(c if c.isprintable() else "?" for c in text or type(problem).__name__)
    if isinstance(problem, LookupError):
        text = f"{text} is missing" if isinstance(problem, KeyError) else text
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]} …"
