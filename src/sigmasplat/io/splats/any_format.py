"""Read a map in whichever format it is, recognised by content: the name may be anything."""

from pathlib import Path

from sigmasplat.errors import SourceError
from sigmasplat.io.ply_elements import read_header
from sigmasplat.io.splats import compressed_ply, ply, splat, spz
from sigmasplat.model.field import GaussianField

READABLE = ".ply, .compressed.ply, .splat or .spz"
FOREIGN = {
    b"NGSP": "is SPZ of version 4 or without gzip; save it as SPZ version 3, or as PLY",
    b"PK\x03\x04": "is a zip archive, perhaps SuperSplat's SOG; unpack it, or save the map as PLY",
    b"glTF": "is a GLB model; save the map as PLY",
    b"version https://git-lfs": "is a pointer of Git LFS, not the map itself; run: git lfs pull",
    b"<": "is a web page or XML, not the map itself; download the map again",
    b"{": "is JSON; give the file that holds the splats",
    b"\x89PNG": "is a picture; give the file that holds the splats",
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
    if start.startswith(b"\x1f\x8b\x08"):
        return spz.read_field(path)
    return _read_ply(path) if start[:3] == b"ply" and start[3:4].isspace() else _read_bare(path, start)


def _read_ply(path: Path) -> GaussianField:
    with path.open("rb") as file:
        compressed = compressed_ply.is_compressed(read_header(file, path))
    return compressed_ply.read_field(path) if compressed else ply.read_field(path)


def _read_bare(path: Path, start: bytes) -> GaussianField:
    """Read what begins like no other format: .splat files begin with any bytes. Raises SourceError if it is none."""
    try:
        return splat.read_field(path)
    except SourceError as problem:
        for magic, what in FOREIGN.items():
            if start.lstrip().startswith(magic):
                raise SourceError(f"{path} {what}") from problem
        raise
