"""Write surfaces as PLY, OBJ or GLB with a colour per vertex; read PLY. PLY and GLB also hold depth_std_m, if known."""

import json
import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import RunError, SourceError
from sigmasplat.io.atomic import replacing
from sigmasplat.io.binary import open_binary
from sigmasplat.io.ply_elements import BYTE_ORDERS, MAX_HEADER_BYTES, PLY_TYPES
from sigmasplat.model.mesh import Mesh

ElementHeader = tuple[str, int, list[list[str]]]

FLOAT32, UINT32, VERTEX_TARGET, INDEX_TARGET = 5126, 5125, 34962, 34963
"""Constants of the glTF 2.0 specification."""


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a mesh in the format of the path's ending, atomically. Raises RunError on an unknown ending or if the file
    cannot be written."""
    check_ending(path)
    content = _FORMATS[path.suffix.lower()](mesh)
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
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
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
    data = file.read(count * row.itemsize)
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


def _ply(mesh: Mesh) -> bytes:
    """Return the mesh as binary little-endian PLY: float x y z, uchar red green blue, float depth_std_m if it is known,
    faces as lists of int."""
    columns = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    columns += [] if mesh.depth_std_m is None else [("depth_std_m", "<f4")]
    vertices = np.zeros(len(mesh.vertices), np.dtype(columns))
    for k, name in enumerate("xyz"):
        vertices[name] = mesh.vertices[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        vertices[name] = _bytes(mesh)[:, k]
    if mesh.depth_std_m is not None:
        vertices["depth_std_m"] = mesh.depth_std_m
    faces = np.zeros(len(mesh.faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    faces["count"], faces["corners"] = 3, mesh.faces
    properties = [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in columns]
    header = [
        "ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *properties,
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    return "".join(f"{line}\n" for line in header).encode("ascii") + vertices.tobytes() + faces.tobytes()


def _obj(mesh: Mesh) -> bytes:
    """Return the mesh as Wavefront OBJ; the colour follows each vertex, as MeshLab and Blender read it."""
    rows = np.concatenate([mesh.vertices.astype(np.float64), _bytes(mesh) / 255.0], 1)
    vertices = ("v %.5f %.5f %.5f %.4f %.4f %.4f\n" * len(rows)) % tuple(rows.ravel().tolist())
    faces = ("f %d %d %d\n" * len(mesh.faces)) % tuple((mesh.faces + 1).ravel().tolist())
    return (vertices + faces).encode("ascii")


def _glb(mesh: Mesh) -> bytes:
    """Return the mesh as binary glTF 2.0, rotated by 180° about x, since glTF's y axis points up.

    depth_std_m becomes `_DEPTH_STD_M`: glTF requires an underscore before the names of own attributes.
    """
    own = [] if mesh.depth_std_m is None else [mesh.depth_std_m.astype("<f4")]
    colors = (_bytes(mesh) / np.float32(255.0)).astype("<f4")
    arrays = [mesh.vertices.astype("<f4"), colors, *own, mesh.faces.astype("<u4")]
    starts = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    targets = [VERTEX_TARGET] * (len(arrays) - 1) + [INDEX_TARGET]
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target}
        for array, start, target in zip(arrays, starts, targets, strict=False)
    ]
    bounds = {"min": mesh.vertices.min(0).tolist(), "max": mesh.vertices.max(0).tolist()} if len(mesh.vertices) else {}
    accessors = [
        {"bufferView": 0, "componentType": FLOAT32, "count": len(mesh.vertices), "type": "VEC3"} | bounds,
        {"bufferView": 1, "componentType": FLOAT32, "count": len(mesh.vertices), "type": "VEC3"},
        *[{"bufferView": 2, "componentType": FLOAT32, "count": len(mesh.vertices), "type": "SCALAR"} for _ in own],
        {"bufferView": 2 + len(own), "componentType": UINT32, "count": mesh.faces.size, "type": "SCALAR"},
    ]
    attributes = {"POSITION": 0, "COLOR_0": 1} | ({"_DEPTH_STD_M": 2} if own else {})
    primitive = {"attributes": attributes, "indices": 2 + len(own)}
    scene = {
        "asset": {"version": "2.0", "generator": "sigmasplat"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": [1.0, 0.0, 0.0, 0.0]}], "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": starts[-1]}], "bufferViews": views, "accessors": accessors,
    }  # fmt: skip
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", starts[-1], b"BIN\0")
    binary = b"".join(array.tobytes() for array in arrays)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks) + len(binary)) + chunks + binary


def _bytes(mesh: Mesh) -> NDArray[np.uint8]:
    """Return the vertices' colours as bytes [V, 3]; gray if the mesh has no colours."""
    return color_bytes(np.full(mesh.vertices.shape, 0.7, np.float32) if mesh.colors is None else mesh.colors)


def color_bytes(colors: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Convert colours in [0, 1] to bytes; values outside are clipped."""
    return np.asarray(np.rint(np.clip(colors, 0.0, 1.0) * 255.0), np.uint8)


_FORMATS = {".ply": _ply, ".obj": _obj, ".glb": _glb}
