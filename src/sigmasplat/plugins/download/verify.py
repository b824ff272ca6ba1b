"""Compare a downloaded file with its checksum: the published one, or that of the first download."""

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.errors import DownloadError
from sigmasplat.files.atomic import write_text

if TYPE_CHECKING:
    from sigmasplat.types import Progress

CHUNK_BYTES = 2**20


def verify(path: Path, published: str, progress: "Progress") -> str:
    """Return "algorithm:digest" of a file whose checksum is correct.

    `published` is the expected "algorithm:digest"; the start of a digest is enough (PyTorch publishes eight digits of
    SHA-256 in its file names). If it is "", the digest is compared with `path`.sha256, which is
    written at the first call. If they differ, the file is removed. Raises DownloadError.
    """
    algorithm = published.partition(":")[0] or "sha256"
    found = f"{algorithm}:{_digest(path, algorithm, progress)}"
    record = path.with_name(f"{path.name}.sha256")
    wanted = published or _recorded_checksum(record)
    if wanted and not found.startswith(wanted):
        path.unlink()
        raise DownloadError(f"{path} was damaged and has been removed; {_advice(record, published, found, wanted)}")
    if not wanted:
        write_text(record, f"{found.partition(':')[2]}  {path.name}\n")
    return found


def _digest(path: Path, algorithm: str, progress: "Progress") -> str:
    digest = hashlib.new(algorithm, usedforsecurity=False)  # some publish only MD5: detects damage, not attacks
    done, total = 0, path.stat().st_size
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
            done += len(chunk)
            progress(done, total)
    return digest.hexdigest()


def _recorded_checksum(record: Path) -> str:
    """Return the checksum from a file in the format of sha256sum, "" if there is no file."""
    words = record.read_text(encoding="utf-8").split() if record.is_file() else []
    return f"sha256:{words[0]}" if words else ""


def _advice(record: Path, published: str, found: str, wanted: str) -> str:
    if published:
        return f"its checksum is {found}, not {wanted}; run it again"
    return f"its checksum has changed (before {wanted}, now {found}); run it again, or delete {record} to accept it"
