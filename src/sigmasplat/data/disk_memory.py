"""Memory in an unnamed file: the system keeps in RAM only what was used lately."""

import mmap
import os
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile

STEP_BYTES = 2**20
"""The file grows by this much, or by an eighth."""


class DiskMemory:
    """Growing memory in an unnamed file of a folder.

    The file has no name, so it is gone when the process ends, however it ends: nothing can be left over, and nothing is
    read from it later. Raises OSError if the file cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        existing = next(path for path in (folder, *folder.absolute().parents) if path.is_dir())
        self._file = TemporaryFile(dir=existing, buffering=0)  # noqa: SIM115 - it lives as long as this object
        self._map: mmap.mmap | None = None
        self.size = 0

    def grown(self, size: int) -> mmap.mmap:
        """Return the memory with at least so many bytes; its content is kept, and earlier maps of it stay valid.

        Raises OSError if the disk is full: space is reserved here, because a disk that is full when memory is written
        would end the process.
        """
        steps = -(-max(size, self.size + self.size // 8) // STEP_BYTES)
        reserve = getattr(os, "posix_fallocate", None)
        if reserve is None:
            raise OSError("this system cannot reserve space in a file")
        reserve(self._file.fileno(), 0, steps * STEP_BYTES)
        self.size = steps * STEP_BYTES
        self._map = mmap.mmap(self._file.fileno(), self.size)
        return self._map

    def release(self) -> None:
        """Give the RAM back to the system; the content is read from the file when it is next used."""
        if self._map is not None:
            with suppress(OSError):
                self._map.madvise(mmap.MADV_DONTNEED)
