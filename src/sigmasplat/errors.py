"""Define the errors that a user can cause. On the command line each is one line and exit code 2."""

from collections.abc import Iterable


class SigmaSplatError(Exception):
    """Base class; the message says in one line what is wrong, what was found and what to do."""


class SourceError(SigmaSplatError):
    """An input sequence is missing, unreadable, inconsistent or of unknown format."""


class ConfigError(SigmaSplatError):
    """A setting has an unknown name, a value out of range, or contradicts another one."""


class RunError(SigmaSplatError):
    """A run folder is not writable, already exists, or was not made by SigmaSplat."""


class BackendError(SigmaSplatError):
    """This machine or this build does not support the requested compute backend."""


class DownloadError(SigmaSplatError):
    """A download failed: unknown data set, no connection, damaged or unsafe archive, or disk full."""


MEMORY_WORDS = (
    "allocate memory", "bad_alloc", "bad allocation", "out of memory", "insufficient memory", "not enough memory",
    "failed to map segment", "can't start new thread",
)  # fmt: skip
"""Words in the messages of libraries that have no type of exception for exhausted memory: torch, OpenCV, the loader."""


def is_out_of_memory(problem: BaseException) -> bool:
    """Return whether an exception says that memory is exhausted: MemoryError, or an error of torch, OpenCV or the
    system with such a message."""
    if isinstance(problem, MemoryError):
        return True
    if not isinstance(problem, RuntimeError | OSError | ImportError) and type(problem).__module__ != "cv2":
        return False
    return any(words in str(problem).lower() for words in MEMORY_WORDS)


def out_of_memory(problem: BaseException) -> str:
    """Return the line for an exception that says that memory is exhausted, with its notes."""
    what = next(iter(str(problem).strip().splitlines()), "") or type(problem).__name__
    notes = "".join(f"; {note}" for note in getattr(problem, "__notes__", ()))
    return f"out of memory ({what}); close other programs, or use smaller images (--set input.width=…){notes}"


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a suggestion for a misspelt name, "" if no known name is similar."""
    import difflib  # only a message needs it

    close = difflib.get_close_matches(name, list(known), 1)
    return f" (did you mean {close[0]}?)" if close else ""
