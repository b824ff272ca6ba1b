"""Read a map in any format. The format is recognised by the content, not by the file's name."""

from collections.abc import Callable
from pathlib import Path

from sigmasplat.api import GaussianField, SourceError, guarded, open_binary, splat_ply as ply
from sigmasplat.plugins.outputs.splats import gltf, sog, splat, spz

READABLE = ".ply, .splat, .spz, .sog or .glb"
START = 4096
"""The first bytes of a file, which decide its format."""
READERS: dict[bytes, Callable[[Path], GaussianField]] = {
    spz.GZIP: spz.read_field,
    spz.MAGIC: spz.read_field,
    sog.MAGIC: sog.read_field,
    gltf.MAGIC: gltf.read_field,
}
"""Readers by the first bytes of a file."""
OTHER_FILES = {
    b"version https://git-lfs": "is a Git LFS pointer, not the map itself; run: git lfs pull",
    b"<": "is a web page or XML, not the map itself; download the map again",
    b"{": "is JSON; give the file with the splats, of glTF the .glb",
    b"PXR-USDC": "is OpenUSD, which is not read; save it as glTF or PLY",
    b"#usda": "is OpenUSD, which is not read; save it as glTF or PLY",
    b"\x89PNG": "is an image; give the file with the splats",
}
"""Messages about other files that users give by mistake, by their first bytes."""


def read_any(path: Path) -> GaussianField:
    """Read a map in any of the formats of `READABLE`; σ² that is not in the file becomes exp(−7).

    Raises SourceError if it is missing, a folder, damaged, or of another format.
    """
    if path.is_dir():
        raise SourceError(f"{path} is a folder, not a map; give a file: {READABLE}")
    with guarded(path, "copy or download it again", SourceError, "damaged"):
        return _read_known(path)


def _read_known(path: Path) -> GaussianField:
    with open_binary(path, "cannot read map") as file:
        start = file.read(START)
    if start[:3] == b"ply" and start[3:4].isspace():
        if b"\nelement chunk " in start:
            raise SourceError(f"{path} is SuperSplat's compressed PLY, which is not read; save it as SOG or as PLY")
        return ply.read_field(path)
    for magic, read in READERS.items():
        if start.startswith(magic):
            return read(path)
    return _read_headerless(path, start)


def _read_headerless(path: Path, start: bytes) -> GaussianField:
    """Read a .splat file, which has no header. Raises SourceError if it is none."""
    try:
        return splat.read_field(path)
    except SourceError as problem:
        for magic, what in OTHER_FILES.items():
            if start.lstrip().startswith(magic):
                raise SourceError(f"{path} {what}") from problem
        raise
