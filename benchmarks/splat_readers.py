"""Read what `sigmasplat export` writes as PLY, SPZ, SOG and glTF: for figures and tests, without checks of the file."""

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from sigmasplat.data.field import ATTRIBUTES, COLUMNS, INITIAL_LOG_VARIANCE, WIDTH, GaussianField, Rows
from sigmasplat.data.harmonics import count
from sigmasplat.run_folder import splat_ply as ply
from sigmasplat.run_folder.splat_values import SH_C0, SplatValues, unit

GLTF = "KHR_gaussian_splatting:"


def read_any(path: Path) -> GaussianField:
    """Read a map; its format follows from the first bytes. σ² that is not in the file becomes exp(−7)."""
    start = path.read_bytes()[:4]
    readers = {b"\x1f\x8b": _spz, b"PK": _sog, b"gl": _glb}
    return readers[start[:2]](path) if start[:2] in readers else ply.read_field(path)


def field_of(values: SplatValues, sigmas: np.ndarray | None = None) -> GaussianField:
    """Return a field of values; sigmas [N, 3]: σ of each channel."""
    params = np.full((len(values), WIDTH), INITIAL_LOG_VARIANCE, np.float32)
    for name in ("means", "quats", "log_scales", "colors"):
        params[:, COLUMNS[name]] = getattr(values, name)
    if sigmas is not None:
        params[:, COLUMNS["log_variances"]] = 2.0 * np.log(sigmas)
    params[:, 10] = np.log(values.opacities) - np.log1p(-values.opacities)
    field = GaussianField(torch.from_numpy(params))
    if values.degree:
        harmonics = np.zeros((len(values), ATTRIBUTES["harmonics"]), np.float32)
        harmonics[:, : values.harmonics.shape[1]] = values.harmonics
        field.attributes["harmonics"] = Rows(torch.from_numpy(harmonics))
    return field


def from_smallest_three(which: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return unit quaternions [N, 4] from the result of `smallest_three`."""
    quats = np.empty((len(which), 4))
    quats[np.arange(4) != which[:, None]] = others.ravel()
    quats[np.arange(len(which)), which] = np.sqrt(np.maximum(1.0 - (others**2).sum(1), 0.0))
    return unit(quats)


def _opacities(values: np.ndarray) -> np.ndarray:
    return np.clip(values / 255.0, 0.25 / 255.0, 1.0 - 0.25 / 255.0)


def _spz(path: Path) -> GaussianField:
    data = gzip.decompress(path.read_bytes())
    _, version, n, degree, bits, _, _ = struct.unpack_from("<4sIIBBBB", data)
    assert version == 3
    parts, at = [], 16
    for width in (9, 1, 3, 3, 4, 3 * count(degree)):
        parts.append(np.frombuffer(data, "u1", n * width, at).reshape(n, width))
        at += n * width
    positions, opacities, colors, scales, rotations, harmonics = parts
    low, middle, high = (positions[:, i::3].astype(np.int32) for i in range(3))
    word = np.ascontiguousarray(rotations).view("<u4")[:, 0]
    signed = [(1.0 - 2.0 * (word >> s + 9 & 1)) * (word >> s & 511) / 511 * np.sqrt(0.5) for s in (20, 10, 0)]
    xyzw = from_smallest_three((word >> 30).astype(np.intp), np.stack(signed, 1))
    values = SplatValues(
        (low | middle << 8 | (high ^ 128) - 128 << 16) / 2.0**bits, np.roll(xyzw, 1, axis=1), scales / 16.0 - 10.0,
        _opacities(opacities[:, 0]), (colors / 255.0 - 0.5) / 0.15 * SH_C0 + 0.5, (harmonics - 128.0) / 128.0,
    )  # fmt: skip
    return field_of(values.turned_about_x())


def _sog(path: Path) -> GaussianField:
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))

        def image(group: str, index: int = 0) -> np.ndarray:
            with Image.open(io.BytesIO(archive.read(meta[group]["files"][index]))) as picture:
                return np.asarray(picture.convert("RGBA")).reshape(-1, 4)

        return field_of(_sog_values(meta, image))


def _sog_values(meta: dict[str, Any], image: Callable[..., np.ndarray]) -> SplatValues:
    n, books = meta["count"], {name: np.array(meta[name].get("codebook", ())) for name in ("scales", "sh0")}
    low, high = (np.array(meta["means"][end]) for end in ("mins", "maxs"))
    steps = image("means", 0)[:n, :3] + 256.0 * image("means", 1)[:n, :3]
    logs, quats, sh0 = low + (high - low) * steps / 65535.0, image("quats")[:n], image("sh0")[:n]
    harmonics = np.empty((n, 0))
    if "shN" in meta:
        table = np.array(meta["shN"]["codebook"])[image("shN", 0)[:, :3]].reshape(-1, 3 * count(meta["shN"]["bands"]))
        harmonics = table[image("shN", 1)[:n, :2].astype(int) @ [1, 256]]
    return SplatValues(
        np.sign(logs) * np.expm1(np.abs(logs)),
        from_smallest_three(quats[:, 3].astype(int) - 252, (quats[:, :3] / 255.0 - 0.5) / np.sqrt(0.5)),
        books["scales"][image("scales")[:n, :3]], _opacities(sh0[:, 3]), books["sh0"][sh0[:, :3]] * SH_C0 + 0.5,
        harmonics,
    )  # fmt: skip


def _glb(path: Path) -> GaussianField:
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + size])
    names = document["meshes"][0]["primitives"][0]["attributes"]

    def attribute(name: str) -> np.ndarray:
        view, n = document["bufferViews"][names[name]], document["accessors"][names[name]]["count"]
        return np.frombuffer(data, "<f4", view["byteLength"] // 4, 28 + size + view["byteOffset"]).reshape(n, -1)

    degree = max(d for d in range(4) if f"{GLTF}SH_DEGREE_{d}_COEF_0" in names)
    harmonics = [attribute(f"{GLTF}SH_DEGREE_{d}_COEF_{i}") for d in range(1, degree + 1) for i in range(2 * d + 1)]
    values = SplatValues(
        attribute("POSITION"), np.roll(attribute(f"{GLTF}ROTATION"), 1, axis=1), np.log(attribute(f"{GLTF}SCALE")),
        np.clip(attribute(f"{GLTF}OPACITY")[:, 0].astype(float), 1e-7, 1.0 - 1e-7),
        attribute(f"{GLTF}SH_DEGREE_0_COEF_0") * SH_C0 + 0.5,
        np.concatenate(harmonics, axis=1) if harmonics else np.empty((len(attribute("POSITION")), 0)),
    )  # fmt: skip
    return field_of(values.turned_about_x(), attribute("_SIGMA") if "_SIGMA" in names else None)
