"""Read a map in any format. The format is recognised by the content, not by the file's name."""

from pathlib import Path

from sigmasplat.errors import SourceError
from sigmasplat.io.binary import open_binary
from sigmasplat.io.ply_elements import read_header
from sigmasplat.io.splats import compressed_ply, ply, splat, spz, spz_container
from sigmasplat.model.field import GaussianField

READABLE = ".ply, .compressed.ply, .splat or .spz"
OTHER_FILES = {
    b"PK\x03\x04": "is a zip archive, perhaps SuperSplat's SOG; unpack it, or save the map as PLY",
    b"glTF": "is a GLB model; save the map as PLY",
    b"version https://git-lfs": "is a Git LFS pointer, not the map itself; run: git lfs pull",
    b"<": "is a web page or XML, not the map itself; download the map again",
    b"{": "is JSON; give the file with the splats",
    b"\x89PNG": "is an image; give the file with the splats",
}
"""Messages about other files that users give by mistake, by their first bytes."""


def read_any(path: Path) -> GaussianField:
    """Read a map: 3DGS PLY, SuperSplat's compressed PLY, .splat or SPZ; σ² that is not in the file becomes exp(−7).

    Raises SourceError if it is missing, a folder, damaged, or of another format.
    """
    if path.is_dir():
        raise SourceError(f"{path} is a folder, not a map; give a file: {READABLE}")
    with open_binary(path, "cannot read map") as file:
        start = file.read(32)
    if start.startswith((spz_container.GZIP, spz_container.MAGIC)):
        return spz.read_field(path)
    return _read_ply(path) if start[:3] == b"ply" and start[3:4].isspace() else _read_headerless(path, start)


def _read_ply(path: Path) -> GaussianField:
    with open_binary(path, "cannot read map") as file:
        compressed = compressed_ply.is_compressed(read_header(file, path))
    return compressed_ply.read_field(path) if compressed else ply.read_field(path)


def _read_headerless(path: Path, start: bytes) -> GaussianField:
    """Read a .splat file, which has no header. Raises SourceError if it is not one."""
    try:
        return splat.read_field(path)
    except SourceError as problem:
        for magic, what in OTHER_FILES.items():
            if start.lstrip().startswith(magic):
                raise SourceError(f"{path} {what}") from problem
        raise
