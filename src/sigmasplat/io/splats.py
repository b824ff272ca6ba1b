"""Read a map in whichever format it is, recognised by content: the name may be anything."""

from collections.abc import Callable
from pathlib import Path

from sigmasplat.errors import SourceError
from sigmasplat.io import compressed_ply, ply, splat, spz
from sigmasplat.io.ply_elements import read_header
from sigmasplat.model.field import GaussianField

READABLE = ".ply, .compressed.ply, .splat or .spz"
FOREIGN = {
    b"NGSP": "SPZ of version 4 or without gzip; save it as SPZ version 3, or as PLY",
    b"PK\x03\x04": "a zip archive, perhaps SuperSplat's SOG; unpack it, or save the map as PLY",
    b"glTF": "a GLB model; save the map as PLY",
    b"version https://git-lfs": "a pointer of Git LFS, not the map itself; run: git lfs pull",
    b"<": "a web page or XML, not the map itself; download the map again",
    b"{": "JSON; give the file that holds the splats",
    b"\x89PNG": "a picture; give the file that holds the splats",
}
"""What else people give, by how it begins, and what to do then."""


def read_any(path: Path) -> GaussianField:
    """Read a map: 3DGS PLY, SuperSplat's compressed PLY, .splat or SPZ; σ² where it was not kept is exp(−7).

    Raises SourceError if it is missing, a folder, damaged, or none of these.
    """
    if path.is_dir():
        raise SourceError(f"{path} is a folder, not a map; give a file: {READABLE}")
    try:
        with path.open("rb") as file:
            start = file.read(32)
    except OSError as problem:
        raise SourceError(f"cannot read map {path}: {problem.strerror or problem}") from problem
    return _reader(path, start)(path)


def _reader(path: Path, start: bytes) -> Callable[[Path], GaussianField]:
    """Choose the reader by the first bytes of a file. Raises SourceError where none reads it."""
    if start[:3] == b"ply" and start[3:4].isspace():
        with path.open("rb") as file:
            return (
                compressed_ply.read_field if compressed_ply.is_compressed(read_header(file, path)) else ply.read_field
            )
    if start.startswith(b"\x1f\x8b"):
        return spz.read_field
    for magic, what in FOREIGN.items():
        if start.lstrip().startswith(magic):
            raise SourceError(f"{path} is {what}")
    return splat.read_field
