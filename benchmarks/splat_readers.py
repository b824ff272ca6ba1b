"""Read what `sigmasplat export` writes as PLY and SPZ: for figures and tests, without checks of the file."""

import gzip
import struct
from pathlib import Path

import numpy as np
import torch

from sigmasplat.data.field import ATTRIBUTES, COLUMNS, INITIAL_LOG_VARIANCE, WIDTH, GaussianField, Rows
from sigmasplat.data.harmonics import count
from sigmasplat.run_folder import splat_ply as ply
from sigmasplat.run_folder.splat_values import SH_C0, SplatValues, unit


def read_any(path: Path) -> GaussianField:
    """Read a map; its format follows from the first bytes. σ² that is not in the file becomes exp(−7)."""
    start = path.read_bytes()[:4]
    return _spz(path) if start[:2] == b"\x1f\x8b" else ply.read_field(path)


def field_of(values: SplatValues) -> GaussianField:
    """Return a field of values."""
    params = np.full((len(values), WIDTH), INITIAL_LOG_VARIANCE, np.float32)
    for name in ("means", "quats", "log_scales", "colors"):
        params[:, COLUMNS[name]] = getattr(values, name)
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
