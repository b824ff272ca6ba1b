"""Write surfaces as PLY or GLB with normals and colours, as GLB or USDZ with a texture, or as STL; read PLY.

PLY and GLB have depth_std_m too, if it is known; PLY also `filled`, the vertices that only close gaps. Unit: metre.

A GLB looks in every viewer as it was recorded. Colours of a map contain the light of the room, so the material is unlit
(KHR_materials_unlit). Viewers without the extension use it as a rough surface that is no metal: glTF's default is
metal, which is black without surroundings to reflect. COLOR_0 is linear by definition, and a map's colours are sRGB. A
room is seen from inside and from outside, hence `doubleSided`.
"""

import json
import os
import struct
import zipfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

import sigmasplat.api as api
from sigmasplat.api import Mesh, RunError, SourceError
from sigmasplat.plugins.outputs.mesh_texture import TexturedMesh, vertex_colors

Values = NDArray[np.floating]
NUMBERS = {np.dtype(code): number for code, number in (("<u1", 5121), ("<u2", 5123), ("<u4", 5125), ("<f4", 5126))}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
VERTICES, INDICES = 34962, 34963
"""Kinds of buffer views."""
UNLIT = "KHR_materials_unlit"
MATERIAL: dict[str, Any] = {
    "name": "recorded light",
    "pbrMetallicRoughness": {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0},
    "doubleSided": True,
    "extensions": {UNLIT: {}},
}
TEXTURED = MATERIAL | {"pbrMetallicRoughness": MATERIAL["pbrMetallicRoughness"] | {"baseColorTexture": {"index": 0}}}
LINEAR = {"magFilter": 9729, "minFilter": 9729}  # smaller copies of the texture would mix neighbouring charts


def _glb(mesh: Mesh, note: str) -> bytes:
    """Return a mesh whose y axis points up, as glTF requires, as the bytes of a GLB file.

    POSITION and NORMAL are float32, COLOR_0 is linear in normalised uint16 with alpha 1. depth_std_m becomes
    `_DEPTH_STD_M`: glTF requires an underscore before the names of own attributes. A texture (sRGB by definition) takes
    the place of the colours.
    """
    attributes: dict[str, NDArray[Any]] = {"POSITION": mesh.vertices.astype("<f4"), "NORMAL": _normals(mesh)}
    texture = mesh if isinstance(mesh, TexturedMesh) else None
    attributes |= {"COLOR_0": _linear_colors(mesh)} if texture is None else {"TEXCOORD_0": texture.uv.astype("<f4")}
    if mesh.depth_std_m is not None:
        attributes["_DEPTH_STD_M"] = mesh.depth_std_m.astype("<f4")
    arrays = [*attributes.values(), mesh.faces.astype("<u4").ravel()]
    views = len(arrays)
    if texture is not None:
        arrays.append(np.frombuffer(texture.image, np.uint8))
    document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "SigmaSplat"}, "scene": 0, "scenes": [{}]}
    if not all(array.size for array in arrays):  # glTF has no empty accessors
        return _packed(document, b"")
    starts = np.cumsum([0, *(array.nbytes + -array.nbytes % 4 for array in arrays)]).tolist()
    accessors: list[dict[str, Any]] = [
        {"bufferView": i, "componentType": NUMBERS[array.dtype], "count": len(array)}
        | {"type": TYPES[1 if array.ndim == 1 else array.shape[1]]}
        | ({"normalized": True} if array.dtype == np.uint16 else {})
        for i, array in enumerate(arrays[:views])
    ]
    accessors[0] |= {end: [float(x) for x in getattr(mesh.vertices, end)(0)] for end in ("min", "max")}
    of_mesh = {"attributes": {key: i for i, key in enumerate(attributes)}, "material": 0, "indices": len(attributes)}
    document |= {
        "extensionsUsed": [UNLIT],
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "surface"}],
        "meshes": [{"primitives": [of_mesh]}],
        "materials": [MATERIAL if texture is None else TEXTURED],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes}
            | ({"target": VERTICES if i < len(attributes) else INDICES} if i < views else {})
            for i, (start, array) in enumerate(zip(starts, arrays, strict=False))
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    if texture is not None:
        image = {"mimeType": "image/jpeg", "bufferView": views}
        document |= {"images": [image], "samplers": [LINEAR], "textures": [{"source": 0, "sampler": 0}]}
    return _packed(document, b"".join(array.tobytes() + bytes(-array.nbytes % 4) for array in arrays))


def _packed(document: Mapping[str, Any], data: bytes) -> bytes:
    """Return a GLB: the document as JSON and, if there are any, the data; the length of a chunk is a multiple of 4."""
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = [(b"JSON", text + b" " * (-len(text) % 4)), *([(b"BIN\0", data)] if data else [])]
    body = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def linear(srgb: Values) -> NDArray[np.float64]:
    """Convert sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    values = np.asarray(srgb, np.float64)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _linear_colors(mesh: Mesh) -> NDArray[np.uint16]:
    rgba = np.ones((len(mesh.vertices), 4))
    rgba[:, :3] = linear(np.clip(vertex_colors(mesh), 0.0, 1.0))
    return np.rint(rgba * 65535.0).astype("<u2")


def _normals(mesh: Mesh) -> NDArray[np.float32]:
    """Return unit normals; a vertex without an area gets an arbitrary one, as glTF requires unit length."""
    normals = mesh.normals()
    normals[(normals**2).sum(1) < 0.5] = (0.0, 1.0, 0.0)
    return normals.astype("<f4")


NOTE = "sigmasplat, unit metre"


def write_mesh(path: Path, mesh: Mesh, note: str = NOTE) -> None:
    """Write a mesh in the format of the path's ending, atomically; the axes of the vertices stay as they are.

    Vertices for GLB and USDZ have y up, as glTF requires. note: one line of ASCII for the header of PLY and STL, for
    instance its axes. Raises RunError on an unknown ending or if the file cannot be written.
    """
    check_ending(path)
    content = _FORMATS[path.suffix.lower()](mesh, note)
    with api.replacing(path) as temporary:
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
    with api.open_binary(path, "cannot read mesh") as file:
        rows = {element.name: _rows(file, path, element) for element in api.read_header(file, path)}
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


def _rows(file: BinaryIO, path: Path, element: api.Element) -> NDArray[np.void]:
    """Read one element. All lists are read with the length of the first one; their lengths are column "NAME count"."""
    fields: list[tuple[str, str] | tuple[str, str, int]] = []
    length, order, count = 0, element.order, element.count
    if count < 0:
        raise SourceError(f"{path}: its header has no number of '{element.name}'; save the mesh again")
    for words in element.properties:
        kinds = [api.PLY_TYPES.get(word) for word in words[:-1] if word != "list"]
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
        raise SourceError(f"{path} is truncated: its header says {count} of element {element.name}, found {len(whole)}")
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
    faces = np.zeros(len(mesh.faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    faces["count"], faces["corners"] = 3, mesh.faces
    groups: list[tuple[str, str, NDArray[Any] | None]] = [
        ("x y z", "float", mesh.vertices), ("nx ny nz", "float", mesh.normals()),
        ("red green blue", "uchar", api.to_bytes(vertex_colors(mesh) * 255.0)),
        ("depth_std_m", "float", mesh.depth_std_m), ("filled", "uchar", mesh.filled),
    ]  # fmt: skip
    known = [(names.split(), kind, values) for names, kind, values in groups if values is not None]
    vertices = np.zeros(
        len(mesh.vertices), [(names[0], f"<{api.PLY_TYPES[kind]}", len(names)) for names, kind, _ in known]
    )
    for names, _, values in known:
        vertices[names[0]] = values.reshape(-1, len(names))
    columns = [f"{kind} {name}" for names, kind, _ in known for name in names]
    corners = ("face", len(faces), ["list uchar int vertex_indices"])
    return (
        api.header_of(("vertex", len(vertices), columns), corners, comment=note) + vertices.tobytes() + faces.tobytes()
    )


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


def _usdz(mesh: Mesh, note: str) -> bytes:
    """Return a textured mesh whose y axis points up as USDZ: a zip file without compression whose parts begin at
    multiples of 64 bytes. The texture is emitted and nothing is reflected. Raises RunError without a texture."""
    if not isinstance(mesh, TexturedMesh):
        raise RunError("a USDZ needs a surface with a texture, found none; write a GLB, PLY or STL")
    ends = np.stack([mesh.vertices.min(0), mesh.vertices.max(0)])
    st = mesh.uv * (1, -1) + (0, 1)  # USD counts from the lower left corner
    points = (", ".join(f"({', '.join(f'{x:.7g}' for x in row)})" for row in of.tolist()) for of in (mesh.vertices, st))
    extent, counts = str(list(map(tuple, ends.tolist())))[1:-1], [3] * len(mesh.faces)
    form = Path(__file__).with_name("mesh.usda").read_text(encoding="utf-8")
    scene = form % (extent, counts, mesh.faces.ravel().tolist(), *points)
    file = BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in (("surface.usda", scene.encode()), ("texture.jpg", mesh.image)):
            part = zipfile.ZipInfo(name)  # of 1980: the same surface gives the same bytes
            fill = -(file.tell() + 30 + len(name) + 4) % 64  # the headers of the part and of its extra field
            part.extra = struct.pack("<HH", 0x1986, fill) + bytes(fill)
            archive.writestr(part, content)
    return file.getvalue()


_FORMATS = {".ply": _ply, ".glb": _glb, ".stl": _stl, ".usdz": _usdz}
