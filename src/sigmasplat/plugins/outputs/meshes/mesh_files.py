"""Write surfaces as PLY, OBJ or GLB with a normal and a colour per vertex, or as STL; read PLY.

PLY and GLB also contain depth_std_m, if it is known; PLY also `filled`, the vertices that only close gaps. The unit is
the metre.
"""

import os
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.mesh import Mesh
from sigmasplat.errors import RunError, SourceError
from sigmasplat.files.atomic import replacing
from sigmasplat.files.ply_elements import BYTE_ORDERS, MAX_HEADER_BYTES, PLY_TYPES
from sigmasplat.files.reading import open_binary
from sigmasplat.plugins.outputs.meshes.glb import GRAY, glb

ElementHeader = tuple[str, int, list[list[str]]]

NOTE = "sigmasplat, unit metre"


def write_mesh(path: Path, mesh: Mesh, note: str = NOTE) -> None:
    """Write a mesh in the format of the path's ending, atomically; the axes of the vertices stay as they are.

    Vertices for GLB have y up, as glTF requires. note: one line of ASCII for the header of PLY, OBJ and STL, for
    instance its axes. Raises RunError on an unknown ending or if the file cannot be written.
    """
    check_ending(path)
    content = _FORMATS[path.suffix.lower()](mesh, note)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def check_ending(path: Path) -> None:
    """Raise RunError unless the path's ending is that of a mesh."""
    if path.suffix.lower() not in _FORMATS:
        raise RunError(f"cannot write a mesh as {path.name}; give a name that ends in {', '.join(_FORMATS)}")


def read_mesh(path: Path) -> Mesh:
    """Read a binary PLY from SigmaSplat or another program; colours are bytes or floats in [0, 1].

    All faces have the same number of vertices; polygons such as the quads of Replica are divided into triangles.
    Raises SourceError if it is missing, truncated, not such a PLY, or not a valid mesh.
    """
    with open_binary(path, "cannot read mesh") as file:
        order, elements = _header(file, path)
        rows = {name: _rows(file, path, order, name, count, fields) for name, count, fields in elements}
    vertices, faces = rows.get("vertex"), rows.get("face")
    if vertices is None or faces is None or not {"x", "y", "z"} <= set(vertices.dtype.names or ()):
        raise SourceError(f"{path} is not a mesh: it needs vertices with x, y, z and faces; is it a point cloud?")
    corners = [name for name in ("vertex_indices", "vertex_index") if name in (faces.dtype.names or ())]
    polygons = faces[corners[0]].astype(np.int64) if corners else np.empty((0, 0), np.int64)
    sides = polygons.shape[1]
    if sides < 3 or (faces[f"{corners[0]} count"] != sides).any():
        raise SourceError(f"{path}: not all faces have the same number of vertices; triangulate the mesh first")
    points = np.stack([vertices[name] for name in "xyz"], -1).astype(np.float32)
    fans = [polygons[:, [0, k, k + 1]] for k in range(1, sides - 1)]
    chosen = np.stack(fans, 1).reshape(-1, 3)
    if not np.isfinite(points).all() or (chosen.size and not 0 <= chosen.min() <= chosen.max() < len(points)):
        raise SourceError(f"{path}: the mesh has nan or inf, or faces with vertices that do not exist")
    return Mesh(points, chosen.astype(np.int32), _colors(vertices))


def _colors(vertices: NDArray[np.void]) -> NDArray[np.float32] | None:
    names = ("red", "green", "blue")
    if not set(names) <= set(vertices.dtype.names or ()):
        return None
    colors = np.stack([vertices[name] for name in names], -1)
    scale = 255.0 if colors.dtype.kind in "iu" else 1.0
    return np.clip(colors / np.float32(scale), 0.0, 1.0).astype(np.float32)


def _header(file: BinaryIO, path: Path) -> tuple[str, list[ElementHeader]]:
    """Read the header: byte order, and name, count and properties of each element. Raises SourceError."""
    if file.readline(8).strip() != b"ply":
        raise SourceError(f"{path} is not a PLY file (its first line is not 'ply')")
    order, elements = "", list[ElementHeader]()
    while file.tell() < MAX_HEADER_BYTES and (raw := file.readline(MAX_HEADER_BYTES)):
        words = raw.decode("ascii", "replace").split()
        if words == ["end_header"] and order:
            return order, elements
        if words[:1] == ["format"]:
            order = BYTE_ORDERS.get(" ".join(words[1:2]), "")
            if not order:
                raise SourceError(f"{path}: the PLY is not binary ({' '.join(words)}); save it as binary")
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1][2].append(words[1:])
    raise SourceError(f"{path} is truncated: the PLY's header has no 'end_header'")


def _rows(
    file: BinaryIO, path: Path, order: str, name: str, count: int, properties: list[list[str]]
) -> NDArray[np.void]:
    """Read one element. All lists are read with the length of the first one; their lengths are returned as column
    "NAME count"."""
    fields: list[tuple[str, str] | tuple[str, str, int]] = []
    length = 0
    for words in properties:
        kinds = [PLY_TYPES.get(word) for word in words[:-1] if word != "list"]
        if None in kinds or len(kinds) != (2 if words[0] == "list" else 1):
            raise SourceError(f"{path}: cannot read the PLY's properties ({' '.join(words)})")
        if len(kinds) == 2:
            length = length or _length_after(file, np.dtype([*fields, ("length", f"{order}{kinds[0]}")]))
            fields += [(f"{words[-1]} count", f"{order}{kinds[0]}"), (words[-1], f"{order}{kinds[1]}", length)]
        else:
            fields.append((words[-1], f"{order}{kinds[0]}"))
    row = np.dtype(fields)
    left = os.fstat(file.fileno()).st_size - file.tell()
    data = file.read(min(count * row.itemsize, left))
    whole = np.frombuffer(data[: len(data) // max(row.itemsize, 1) * row.itemsize], row)
    if len(whole) < count and not any((whole[k] != length).any() for k in row.names or () if k.endswith(" count")):
        raise SourceError(f"{path} is truncated: its header says {count} of element {name}, found {len(whole)}")
    return whole


def _length_after(file: BinaryIO, start: np.dtype[np.void]) -> int:
    """Return the length of a list of the first row, whose columns before it and its length are `start`; 3 at the end of
    the file."""
    place, data = file.tell(), file.read(start.itemsize)
    file.seek(place)
    return int(np.frombuffer(data, start)["length"][0]) if len(data) == start.itemsize else 3


def _ply(mesh: Mesh, note: str) -> bytes:
    """Return the mesh as binary little-endian PLY: float x y z, float nx ny nz, uchar red green blue, float depth_std_m
    if it is known, uchar filled (1 = closes a gap) if gaps were closed, faces as lists of int."""
    points, normals, colors = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
    columns = [(name, "<f4") for name in (*points, *normals)] + [(name, "u1") for name in colors]
    columns += [] if mesh.depth_std_m is None else [("depth_std_m", "<f4")]
    columns += [] if mesh.filled is None else [("filled", "u1")]
    vertices = np.zeros(len(mesh.vertices), np.dtype(columns))
    for names, values in ((points, mesh.vertices), (normals, mesh.normals()), (colors, _bytes(mesh))):
        for k, name in enumerate(names):
            vertices[name] = values[:, k]
    if mesh.depth_std_m is not None:
        vertices["depth_std_m"] = mesh.depth_std_m
    if mesh.filled is not None:
        vertices["filled"] = mesh.filled
    faces = np.zeros(len(mesh.faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    faces["count"], faces["corners"] = 3, mesh.faces
    properties = [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in columns]
    header = [
        "ply", "format binary_little_endian 1.0", f"comment {note}", f"element vertex {len(vertices)}", *properties,
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    return "".join(f"{line}\n" for line in header).encode("ascii") + vertices.tobytes() + faces.tobytes()


def _obj(mesh: Mesh, note: str) -> bytes:
    """Return the mesh as Wavefront OBJ; the colour follows each vertex, as MeshLab and Blender read it."""
    rows = np.concatenate([mesh.vertices.astype(np.float64), _bytes(mesh) / 255.0], 1)
    normals = mesh.normals()
    vertices = ("v %.5f %.5f %.5f %.4f %.4f %.4f\n" * len(rows)) % tuple(rows.ravel().tolist())
    directions = ("vn %.4f %.4f %.4f\n" * len(rows)) % tuple(normals.ravel().tolist())
    corners = np.repeat(mesh.faces.ravel() + 1, 2)  # a vertex and its normal have the same number
    faces = ("f %d//%d %d//%d %d//%d\n" * len(mesh.faces)) % tuple(corners.tolist())
    return (f"# {note}\n" + vertices + directions + faces).encode("ascii")


def _stl(mesh: Mesh, note: str) -> bytes:
    """Return the mesh as binary STL, which has neither colours nor shared vertices."""
    corners = mesh.corners
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1, keepdims=True)
    rows = np.zeros(len(corners), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")]))
    rows["normal"] = np.divide(across, length, out=np.zeros_like(across), where=length > 0)
    rows["corners"] = corners
    header = f"binary STL, {note}".encode("ascii")[:80].ljust(80)  # must not begin with "solid", as a text STL does
    return header + len(rows).to_bytes(4, "little") + rows.tobytes()


def _glb(mesh: Mesh, note: str) -> bytes:
    return glb(mesh)


def _bytes(mesh: Mesh) -> NDArray[np.uint8]:
    """Return the vertices' colours as bytes [V, 3]; gray if the mesh has no colours."""
    return color_bytes(np.full(mesh.vertices.shape, GRAY, np.float32) if mesh.colors is None else mesh.colors)


def color_bytes(colors: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Convert colours in [0, 1] to bytes; values outside are clipped."""
    return np.asarray(np.rint(np.clip(colors, 0.0, 1.0) * 255.0), np.uint8)


_FORMATS = {".ply": _ply, ".obj": _obj, ".glb": _glb, ".stl": _stl}
