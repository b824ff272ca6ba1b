"""Write a mesh as binary glTF 2.0 so that it looks as it was recorded in every viewer.

Colours of a map contain the light of the room, so the material is unlit (KHR_materials_unlit). Viewers without the
extension use the same material as a rough surface that is no metal: glTF's default is metal, which is black without
surroundings to reflect. COLOR_0 is linear by definition, and a map's colours are sRGB. A room is seen from inside and
from outside, hence `doubleSided`.
"""

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.mesh import Mesh

UINT16, UINT32, FLOAT32, VERTEX_TARGET, INDEX_TARGET = 5123, 5125, 5126, 34962, 34963
"""Constants of the glTF 2.0 specification."""
GRAY = 0.7
MATERIAL = {
    "name": "recorded light",
    "pbrMetallicRoughness": {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0},
    "doubleSided": True,
    "extensions": {"KHR_materials_unlit": {}},
}


def glb(mesh: Mesh) -> bytes:
    """Return a mesh whose y axis points up, as glTF requires, as the bytes of a GLB file.

    POSITION and NORMAL are float32, COLOR_0 is linear in normalised uint16 with alpha 1. depth_std_m becomes
    `_DEPTH_STD_M`: glTF requires an underscore before the names of own attributes.
    """
    vertices = mesh.vertices.astype("<f4")
    bounds = {"min": vertices.min(0).tolist(), "max": vertices.max(0).tolist()} if len(vertices) else {}
    attributes: dict[str, tuple[NDArray[Any], dict[str, Any]]] = {
        "POSITION": (vertices, {"componentType": FLOAT32, "type": "VEC3", **bounds}),
        "NORMAL": (_normals(mesh), {"componentType": FLOAT32, "type": "VEC3"}),
        "COLOR_0": (_colors(mesh), {"componentType": UINT16, "type": "VEC4", "normalized": True}),
    }
    if mesh.depth_std_m is not None:
        attributes["_DEPTH_STD_M"] = (mesh.depth_std_m.astype("<f4"), {"componentType": FLOAT32, "type": "SCALAR"})
    if not len(mesh.faces):  # glTF has no empty accessors, and a scene without meshes is valid
        return _container({"asset": _ASSET, "scene": 0, "scenes": [{}]}, [])
    arrays = [array for array, _ in attributes.values()] + [mesh.faces.astype("<u4")]
    starts = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    targets = [VERTEX_TARGET] * len(attributes) + [INDEX_TARGET]
    indices = {"componentType": UINT32, "type": "SCALAR", "bufferView": len(attributes), "count": mesh.faces.size}
    accessors = [
        {"bufferView": view, "count": len(vertices), **kind} for view, (_, kind) in enumerate(attributes.values())
    ]
    primitive = {
        "attributes": {name: number for number, name in enumerate(attributes)},
        "indices": len(attributes),
        "material": 0,
    }
    scene = {
        "asset": _ASSET, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "name": "surface"}],
        "meshes": [{"primitives": [primitive]}], "materials": [MATERIAL],
        "extensionsUsed": ["KHR_materials_unlit"], "buffers": [{"byteLength": starts[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target}
            for array, start, target in zip(arrays, starts, targets, strict=False)
        ],
        "accessors": [*accessors, indices],
    }  # fmt: skip
    return _container(scene, arrays)


_ASSET = {"version": "2.0", "generator": "sigmasplat"}


def linear(srgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """Convert sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    values = np.clip(np.asarray(srgb, np.float64), 0.0, 1.0)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _colors(mesh: Mesh) -> NDArray[np.uint16]:
    srgb = np.full(mesh.vertices.shape, GRAY) if mesh.colors is None else mesh.colors
    rgba = np.ones((len(srgb), 4))
    rgba[:, :3] = linear(srgb)
    return np.rint(rgba * 65535.0).astype("<u2")


def _normals(mesh: Mesh) -> NDArray[np.float32]:
    """Return unit normals; a vertex without an area gets an arbitrary one, as glTF requires unit length."""
    normals = mesh.normals()
    normals[(normals**2).sum(1) < 0.5] = (0.0, 1.0, 0.0)
    return normals.astype("<f4")


def _container(scene: dict[str, Any], arrays: list[NDArray[Any]]) -> bytes:
    """Return header, JSON chunk and, if there are arrays, binary chunk; each array has a multiple of 4 bytes."""
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if arrays:
        binary = b"".join(array.tobytes() for array in arrays)
        chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
