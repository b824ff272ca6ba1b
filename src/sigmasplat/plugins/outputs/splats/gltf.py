"""Read and write splats as glTF 2.0 with KHR_gaussian_splatting (release candidate): GLB, or .gltf with data inside.

One primitive of points with float32 attributes: POSITION, and KHR_gaussian_splatting:ROTATION (xyzw), SCALE (metres),
OPACITY (0 to 1) and SH_DEGREE_l_COEF_n (degree 0 is (colour − ½)/C0). Our own attributes, which other readers skip:
_SIGMA, the standard deviation of each colour channel; _CORRELATION if the map has full colour covariances;
_DEPTH_STD_M and _COLOR_STD if they are known. The reader ignores the last two. COLOR_0 is for readers without the
extension, which show points: linear colours and opacity. Colours of splats are those of the images, so `colorSpace` is
srgb_rec709_display. Axes are x right, y up, z back: the writer rotates maps by 180° about x, the reader rotates them
back. Specification: KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting.
"""

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.data.field import COLUMNS, INITIAL_LOG_VARIANCE, GaussianField
from sigmasplat.data.harmonics import DEGREES, count
from sigmasplat.data.map_uncertainty import SplatStd
from sigmasplat.errors import SourceError
from sigmasplat.files.atomic import replacing
from sigmasplat.plugins.outputs.splats.gltf_buffers import FLOAT, GltfFile
from sigmasplat.run_folder.quaternions import Doubles, unit
from sigmasplat.run_folder.splat_values import SH_C0, SplatValues

NAME = "KHR_gaussian_splatting"
MAGIC = b"glTF"
UNSIGNED_BYTE, VERTICES = 5121, 34962
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
JSON_CHUNK, DATA_CHUNK = b"JSON", b"BIN\0"
SMALLEST_SCALE_M = 1e-12


def write_field(path: Path, field: GaussianField, *, std: SplatStd | None = None) -> None:
    """Write the splats atomically: as text if the name ends in .gltf, else as GLB.

    `std` adds its two attributes. Raises RunError if the file cannot be written.
    """
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    attributes: dict[str, int] = {}
    data = bytearray()
    for name, values in _attributes(field, std):
        attributes[name] = len(accessors)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes, "target": VERTICES})
        kind = FLOAT if values.dtype == np.float32 else UNSIGNED_BYTE
        accessor: dict[str, Any] = {"bufferView": len(accessors), "componentType": kind, "count": len(values)}
        accessor["type"] = TYPES[values.shape[1]]
        if kind == UNSIGNED_BYTE:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {end: [float(x) for x in getattr(values, end)(0)] for end in ("min", "max") if len(values)}
        accessors.append(accessor)
        data += values.tobytes()
    splatting = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": attributes, "mode": 0, "material": 0, "extensions": {NAME: splatting}}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "SigmaSplat"},
        "extensionsUsed": [NAME, "KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "map"}],
        "materials": [{"name": "points", "extensions": {"KHR_materials_unlit": {}}}],
    }
    if len(field):
        document["meshes"] = [{"primitives": [primitive]}]
        document |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(data)}]}
    else:  # glTF has no accessor without elements
        del document["nodes"][0]["mesh"]
    with replacing(path) as temporary:
        temporary.write_bytes(_packed(document, bytes(data), path.suffix.lower() == ".gltf"))


def read_field(path: Path) -> GaussianField:
    """Read .glb or .gltf; without _SIGMA, σ² becomes exp(−7). Of several primitives of splats, the first one is read.

    Raises SourceError if it is missing, damaged, truncated, has no splats, or if its node is moved or scaled.
    """
    file = GltfFile.open(path)
    primitive = file.primitive(NAME)
    if primitive is None:
        raise SourceError(f"{path} has no splats ({NAME}), so it is not a map; a mesh cannot be read as a map")

    def attribute(name: str, width: int, prefix: str = f"{NAME}:") -> Doubles:
        return file.attribute(primitive, prefix + name, width)

    means = attribute("POSITION", 3, "")
    rotations = attribute("ROTATION", 4)
    if (np.linalg.norm(rotations, axis=1) < 0.5).any():
        raise SourceError(f"{path} is damaged: a rotation is not a unit quaternion")
    degree = max(d for d in range(DEGREES + 1) if file.has(primitive, f"{NAME}:SH_DEGREE_{d}_COEF_0") or d == 0)
    harmonics = [attribute(f"SH_DEGREE_{d}_COEF_{n}", 3) for d in range(1, degree + 1) for n in range(2 * d + 1)]
    scales, opacities = attribute("SCALE", 3), attribute("OPACITY", 1)[:, 0]
    field = (
        SplatValues(
            means,
            unit(np.roll(rotations, 1, axis=1)),
            np.log(np.maximum(scales, SMALLEST_SCALE_M)),
            np.clip(opacities, 1e-7, 1.0 - 1e-7),
            attribute("SH_DEGREE_0_COEF_0", 3) * SH_C0 + 0.5,
            np.concatenate(harmonics, axis=1) if harmonics else np.empty((len(means), 0)),
        )
        .turned_about_x()
        .field(path)
    )
    if file.has(primitive, "_SIGMA"):
        sigmas = attribute("_SIGMA", 3, "")
        log_variances = np.where(sigmas > 0.0, 2.0 * np.log(np.maximum(sigmas, 1e-18)), INITIAL_LOG_VARIANCE)
        field.params[:, COLUMNS["log_variances"]] = torch.from_numpy(log_variances.astype(np.float32))
    return field


def _attributes(field: GaussianField, std: SplatStd | None) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the names and values [N, m] of the attributes."""
    values = SplatValues.of(field).turned_about_x()
    own: dict[str, Doubles] = {
        "POSITION": values.means,
        f"{NAME}:ROTATION": np.roll(values.quats, -1, axis=1),
        f"{NAME}:SCALE": np.exp(values.log_scales),
        f"{NAME}:OPACITY": values.opacities[:, None],
        f"{NAME}:SH_DEGREE_0_COEF_0": (values.colors - 0.5) / SH_C0,
    }
    for degree in range(1, values.degree + 1):
        for n in range(2 * degree + 1):
            at = 3 * (count(degree - 1) + n)
            own[f"{NAME}:SH_DEGREE_{degree}_COEF_{n}"] = values.harmonics[:, at : at + 3]
    own["_SIGMA"] = field.variances.detach().cpu().double().sqrt().numpy()
    if std is not None:
        own["_DEPTH_STD_M"] = std.depth_std_m.cpu().double().numpy()[:, None]
        own["_COLOR_STD"] = std.color_std.cpu().double().numpy()[:, None]
    for name, array in own.items():
        yield name, array.astype(np.float32)
    colors = np.column_stack([_linear(np.clip(values.colors, 0.0, 1.0)), values.opacities])
    yield "COLOR_0", np.round(colors * 255.0).astype(np.uint8)


def _linear(colors: Doubles) -> Doubles:
    """Convert sRGB colours in [0, 1] to linear ones (IEC 61966-2-1)."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def _packed(document: dict[str, Any], data: bytes, text: bool) -> bytes:
    """Return the bytes of a .gltf with its data in a URI, or of a GLB: two chunks with lengths of multiples of four."""
    if text:
        if data:
            document["buffers"][0]["uri"] = GltfFile.data_uri(data)
        return json.dumps(document).encode()
    words = json.dumps(document, separators=(",", ":")).encode()
    chunks = [
        (JSON_CHUNK, words + b" " * (-len(words) % 4)),
        *([(DATA_CHUNK, data + bytes(-len(data) % 4))] * bool(data)),
    ]
    body = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in chunks)
    return struct.pack("<4sII", MAGIC, 2, 12 + len(body)) + body
