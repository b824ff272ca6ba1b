"""Read and write splats as glTF 2.0 with KHR_gaussian_splatting (release candidate); write GLB, also of meshes.

One primitive of points with float32 attributes: POSITION, and KHR_gaussian_splatting:ROTATION (xyzw), SCALE (metres),
OPACITY (0 to 1) and SH_DEGREE_l_COEF_n (degree 0 is (colour − ½)/C0). Our own attributes, which other readers skip:
_SIGMA, the standard deviation of each colour channel; _DEPTH_STD_M and _COLOR_STD if they are known. The reader ignores
the last two. COLOR_0 is for readers without the extension, which show points: linear colours and opacity. Colours of
splats are those of the images, so `colorSpace` is srgb_rec709_display. Axes are x right, y up, z back: the writer
rotates maps by 180° about x, the reader rotates them back. Sizes are checked before numbers are read; sparse accessors
and compressed buffers cannot be read. Specification: KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting.
"""

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import (
    DEGREES,
    SH_C0,
    Doubles,
    GaussianField,
    SourceError,
    SplatStd,
    SplatValues,
    count,
    log_scales_of,
    open_binary,
    replacing,
    rotations_of,
)

FLOAT = 5126
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
NUMBERS = {np.dtype(code): number for number, code in COMPONENTS.items()}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TYPES = {width: name for name, width in WIDTHS.items()}
UNMOVED = {
    "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
    "translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1],
}  # fmt: skip


@dataclass(frozen=True)
class GltfFile:
    """The JSON document and the data of a GLB."""

    path: Path
    document: Mapping[str, Any]
    chunk: bytes

    @staticmethod
    def open(path: Path) -> "GltfFile":
        """Read a file. Raises SourceError if it is missing, damaged, or not glTF 2.0."""
        with open_binary(path, "cannot read map") as file:
            data, chunk = _chunks(file.read(), path)
        try:
            document = json.loads(data)
            version = str(document["asset"]["version"])
        except (ValueError, TypeError, KeyError, RecursionError) as problem:
            raise SourceError(f"{path} is not glTF 2.0, or is damaged or truncated: {problem}") from problem
        if not version.startswith("2."):
            raise SourceError(f"{path} is glTF {version}; only glTF 2.0 can be read")
        return GltfFile(path, document, chunk)

    def damaged(self, what: str) -> SourceError:
        """Return the error of a file whose document is wrong."""
        return SourceError(f"{self.path} is damaged or not supported: {what}")

    def entry(self, kind: str, index: object) -> Mapping[str, Any]:
        """Return an entry of a list of the document, such as accessor 3. Raises SourceError."""
        entries = self.document.get(kind)
        if isinstance(index, bool) or not isinstance(index, int) or not isinstance(entries, list):
            raise self.damaged(f"{kind} {index} is missing")
        if not 0 <= index < len(entries) or not isinstance(entries[index], Mapping):
            raise self.damaged(f"{kind} {index} is missing")
        found: Mapping[str, Any] = entries[index]
        return found

    def primitive(self, extension: str) -> Mapping[str, Any] | None:
        """Return the first primitive with an extension; None without one. Raises SourceError if its node is moved."""
        meshes = self.document.get("meshes")
        for i in range(len(meshes) if isinstance(meshes, list) else 0):
            for primitive in self._list(self.entry("meshes", i), "primitives"):
                found: Mapping[str, Any] = primitive if isinstance(primitive, Mapping) else {}
                extensions = found.get("extensions")
                if isinstance(extensions, Mapping) and extension in extensions:
                    self._check_node(i)
                    return found
        return None

    def _check_node(self, mesh: int) -> None:
        for node in self._list(self.document, "nodes"):
            if isinstance(node, Mapping) and (node.get("mesh") == mesh or "children" in node):
                for name, value in UNMOVED.items():
                    if node.get(name, value) != value:
                        raise self.damaged(f"its splats are moved by the {name} of a node; apply it before saving")

    def _list(self, owner: Mapping[str, Any], name: str) -> list[Any]:
        found = owner.get(name, [])
        if not isinstance(found, list):
            raise self.damaged(f"{name} is not a list")
        return found

    def has(self, primitive: Mapping[str, Any], name: str) -> bool:
        """Return whether a primitive has an attribute."""
        attributes = primitive.get("attributes")
        return isinstance(attributes, Mapping) and name in attributes

    def attribute(self, primitive: Mapping[str, Any], name: str, width: int) -> Doubles:
        """Return an attribute [N, width], normalised integers as numbers in [−1, 1], N as for POSITION.

        Raises SourceError if it is missing, outside of its buffer, or not finite.
        """
        if not self.has(primitive, name):
            raise self.damaged(f"it has no attribute {name}")
        accessor = self.entry("accessors", primitive["attributes"][name])
        kind, size, at = (self._whole(accessor, key) for key in ("componentType", "count", "byteOffset"))
        if kind not in COMPONENTS or WIDTHS.get(str(accessor.get("type"))) != width or "sparse" in accessor:
            raise self.damaged(f"{name} is not a plain accessor of {width} numbers")
        rows = self.entry("accessors", primitive["attributes"].get("POSITION")).get("count")
        if size != rows:
            raise self.damaged(f"{name} has {size} values for {rows} splats")
        item = np.dtype(COMPONENTS[kind])
        view = self.entry("bufferViews", accessor.get("bufferView"))
        if view.get("extensions"):
            raise self.damaged(f"the buffer of {name} is compressed; save the map without compression")
        stride = self._whole(view, "byteStride") or width * item.itemsize
        start, length = self._whole(view, "byteOffset") + at, self._whole(view, "byteLength") - at
        if "uri" in self.entry("buffers", view.get("buffer")):
            raise self.damaged(f"the data of {name} is in another file; save the map as one GLB")
        data = self.chunk
        if stride < width * item.itemsize or size * stride - stride + width * item.itemsize > length * bool(size):
            raise self.damaged(f"{name} is larger than its part of the buffer")
        if start + length > len(data):
            raise SourceError(f"{self.path} is truncated: {name} ends at byte {start + length} of {len(data)}")
        values = np.ndarray((size, width), item, data, start, (stride, item.itemsize)).astype(np.float64)
        if accessor.get("normalized"):
            values = np.maximum(values / np.iinfo(item).max, -1.0) if kind != FLOAT else values
        if not np.isfinite(values).all():
            raise SourceError(f"{self.path}: {name} has nan or inf")
        return values

    def _whole(self, owner: Mapping[str, Any], name: str) -> int:
        found = owner.get(name, 0)
        if isinstance(found, bool) or not isinstance(found, int) or not 0 <= found < 1 << 53:
            raise self.damaged(f"{name} is not a whole number")
        return found


def _chunks(data: bytes, path: Path) -> tuple[bytes, bytes]:
    """Split a GLB into its document and its data. Raises SourceError."""
    version, length = struct.unpack_from("<II", data, 4) if len(data) >= 12 else (2, len(data) + 1)
    if version != 2 or length > len(data):
        what = f"is a GLB of version {version}" if version != 2 else "is truncated"
        raise SourceError(f"{path} {what}: its header says {length} bytes, found {len(data)}")
    parts, at = dict[bytes, bytes](), 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, at)
        if at + 8 + size > length:
            raise SourceError(f"{path} is truncated: a chunk says {size} bytes, found {length - at - 8}")
        parts.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    return parts.get(JSON_CHUNK, b""), parts.get(DATA_CHUNK, b"")


NAME = "KHR_gaussian_splatting"
MAGIC = b"glTF"
VERTICES, INDICES = 34962, 34963
"""Kinds of buffer views."""
UNLIT = "KHR_materials_unlit"
JSON_CHUNK, DATA_CHUNK = b"JSON", b"BIN\0"


def write_field(path: Path, field: GaussianField, *, std: SplatStd | None = None) -> None:
    """Write the splats atomically as GLB; `std` adds its two attributes. Raises RunError if it cannot be written."""
    splatting = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    material = {"name": "points", "extensions": {UNLIT: {}}}
    data = glb(_attributes(field, std), {"mode": 0, "extensions": {NAME: splatting}}, material, "map")
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def glb(
    attributes: Mapping[str, NDArray[Any]], primitive: Mapping[str, Any], material: Mapping[str, Any], name: str,
    indices: NDArray[np.uint32] | None = None,
) -> bytes:  # fmt: skip
    """Return the bytes of a GLB with one mesh: attributes [N] or [N, m] of its vertices, and indices of its triangles.

    Integer attributes are normalised. primitive, material: their other entries. Without vertices, or with indices
    that are empty, the scene is empty: glTF has no empty accessors.
    """
    document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "SigmaSplat"}, "scene": 0, "scenes": [{}]}
    arrays = [*attributes.values(), *([] if indices is None else [indices])]
    if not all(array.size for array in arrays):
        return _packed(document, b"")
    starts = np.cumsum([0, *(array.nbytes + -array.nbytes % 4 for array in arrays)]).tolist()
    accessors: list[dict[str, Any]] = [
        {"bufferView": i, "componentType": NUMBERS[array.dtype], "count": len(array)}
        | {"type": TYPES[1 if array.ndim == 1 else array.shape[1]]}
        | ({"normalized": True} if array.dtype.kind == "u" and array is not indices else {})
        for i, array in enumerate(arrays)
    ]
    accessors[0] |= {end: [float(x) for x in getattr(attributes["POSITION"], end)(0)] for end in ("min", "max")}
    of_mesh = {"attributes": {key: i for i, key in enumerate(attributes)}, "material": 0, **primitive}
    document |= {
        "extensionsUsed": [*primitive.get("extensions", {}), UNLIT],
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name}],
        "meshes": [{"primitives": [of_mesh if indices is None else of_mesh | {"indices": len(attributes)}]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes}
            | {"target": INDICES if array is indices else VERTICES}
            for start, array in zip(starts, arrays, strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    return _packed(document, b"".join(array.tobytes() + bytes(-array.nbytes % 4) for array in arrays))


def read_field(path: Path) -> GaussianField:
    """Read a GLB; without _SIGMA, σ² becomes exp(−7). Of several primitives of splats, the first one is read.

    Raises SourceError if it is missing, damaged, truncated, has no splats, or if its node is moved or scaled.
    """
    file = GltfFile.open(path)
    primitive = file.primitive(NAME)
    if primitive is None:
        raise SourceError(f"{path} has no splats ({NAME}), so it is not a map; a mesh cannot be read as a map")

    def attribute(name: str, width: int, prefix: str = f"{NAME}:") -> Doubles:
        return file.attribute(primitive, prefix + name, width)

    means = attribute("POSITION", 3, "")
    rotations = rotations_of(attribute("ROTATION", 4), path)
    degree = max(d for d in range(DEGREES + 1) if file.has(primitive, f"{NAME}:SH_DEGREE_{d}_COEF_0") or d == 0)
    harmonics = [attribute(f"SH_DEGREE_{d}_COEF_{n}", 3) for d in range(1, degree + 1) for n in range(2 * d + 1)]
    values = SplatValues(
        means,
        rotations,
        log_scales_of(attribute("SCALE", 3)),
        np.clip(attribute("OPACITY", 1)[:, 0], 1e-7, 1.0 - 1e-7),
        attribute("SH_DEGREE_0_COEF_0", 3) * SH_C0 + 0.5,
        np.concatenate(harmonics, axis=1) if harmonics else np.empty((len(means), 0)),
    )
    sigmas = attribute("_SIGMA", 3, "") if file.has(primitive, "_SIGMA") else None
    return values.turned_about_x().field(path, sigmas)


def _attributes(field: GaussianField, std: SplatStd | None) -> dict[str, NDArray[Any]]:
    """Return the names and values of the attributes, POSITION first."""
    values = SplatValues.of(field).turned_about_x()
    own: dict[str, Doubles] = {
        "POSITION": values.means,
        f"{NAME}:ROTATION": np.roll(values.quats, -1, axis=1),
        f"{NAME}:SCALE": np.exp(values.log_scales),
        f"{NAME}:OPACITY": values.opacities,
        f"{NAME}:SH_DEGREE_0_COEF_0": (values.colors - 0.5) / SH_C0,
    }
    for degree in range(1, values.degree + 1):
        for n in range(2 * degree + 1):
            at = 3 * (count(degree - 1) + n)
            own[f"{NAME}:SH_DEGREE_{degree}_COEF_{n}"] = values.harmonics[:, at : at + 3]
    own["_SIGMA"] = field.variances.detach().cpu().double().sqrt().numpy()
    if std is not None:
        own |= {
            "_DEPTH_STD_M": std.depth_std_m.cpu().double().numpy(),
            "_COLOR_STD": std.color_std.cpu().double().numpy(),
        }
    colors = np.column_stack([linear(values.colors), values.opacities])
    points = {"COLOR_0": np.round(colors * 255.0).astype(np.uint8)}
    return {name: np.ascontiguousarray(array, "<f4") for name, array in own.items()} | points


def linear(srgb: NDArray[np.floating]) -> Doubles:
    """Convert sRGB in [0, 1] to linear light (IEC 61966-2-1); values outside are clipped."""
    values = np.clip(np.asarray(srgb, np.float64), 0.0, 1.0)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _packed(document: Mapping[str, Any], data: bytes) -> bytes:
    """Return a GLB: the document as JSON and, if there are any, the data; the length of a chunk is a multiple of 4."""
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = [(JSON_CHUNK, text + b" " * (-len(text) % 4)), *([(DATA_CHUNK, data)] if data else [])]
    body = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in chunks)
    return struct.pack("<4sII", MAGIC, 2, 12 + len(body)) + body
