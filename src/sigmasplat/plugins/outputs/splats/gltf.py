"""Write splats as glTF 2.0 with KHR_gaussian_splatting (release candidate), and meshes as GLB.

One primitive of points with float32 attributes: POSITION, and KHR_gaussian_splatting:ROTATION (xyzw), SCALE (metres),
OPACITY (0 to 1) and SH_DEGREE_l_COEF_n (degree 0 is (colour − ½)/C0). Our own attributes, which other readers skip:
_SIGMA, the standard deviation of each colour channel; _DEPTH_STD_M and _COLOR_STD if they are known. COLOR_0 is for
readers without the extension, which show points: linear colours and opacity. Colours of splats are those of the images,
so `colorSpace` is srgb_rec709_display. Axes are x right, y up, z back: the writer rotates maps by 180° about x.
Specification: KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting.
"""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.api import SH_C0, Doubles, GaussianField, SplatStd, SplatValues, count, replacing

NUMBERS = {np.dtype(code): number for code, number in (("<u1", 5121), ("<u2", 5123), ("<u4", 5125), ("<f4", 5126))}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
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
