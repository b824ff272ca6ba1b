"""Archives for tests, valid and malicious."""

import io
import stat
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path


def tar_gz(files: Mapping[str, bytes], *strange: tarfile.TarInfo) -> bytes:
    """Return a .tar.gz with files and with entries without content."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as tar:
        for name, content in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
        for entry in strange:
            tar.addfile(entry)
    return packed.getvalue()


def entry(kind: bytes, name: str = "odd", leads_to: str = "") -> tarfile.TarInfo:
    """Return a tar entry that is not a file."""
    made = tarfile.TarInfo(name)
    made.type, made.linkname = kind, leads_to
    return made


def zipped(files: Mapping[str, bytes], links: Mapping[str, str] | None = None) -> bytes:
    """Return a .zip with files and symbolic links."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in files.items():
            made.writestr(name, content)
        for name, leads_to in (links or {}).items():
            link = zipfile.ZipInfo(name)
            link.create_system, link.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
            made.writestr(link, leads_to)
    return packed.getvalue()


def folder_content(folder: Path, below: str = "") -> dict[str, bytes]:
    """Return the content of the files below a folder by relative path."""
    found = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    return {f"{below}{name}": content for name, content in found.items()}
