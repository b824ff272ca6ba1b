"""Read and write splats as 3DGS PLY, the standard format, which SuperSplat and other viewers open.

Columns: x y z, nx ny nz (0), f_dc_0..2 = (colour − ½)/C0, f_rest_0..44 for view-dependent colours (all harmonics of
red, then green, then blue), opacity (logit), scale_0..2 (log metres), rot_0..3 (wxyz), and our own at the end:
log_variance_0..2, then depth_std_m and color_std if they are known. Our reader ignores the last two. Readers that find
columns by name skip ours: SuperSplat and splat-transform (PlayCanvas), antimatter15/splat, nianticlabs/spz. Readers
that assume the fixed 62-float layout and ignore the names would read garbage: the original 3DGS viewer (SIBR),
3DGS.cpp, older Unity importers. `plain` writes exactly these 62 columns, with f_rest 0 if a map has no harmonics. The
header has no comments, because SIBR expects the number of splats in line 3.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.data.field import ATTRIBUTES, COLUMNS, INITIAL_LOG_VARIANCE, GaussianField, Rows
from sigmasplat.data.harmonics import DEGREES, count
from sigmasplat.errors import SourceError
from sigmasplat.files.atomic import replacing
from sigmasplat.files.ply_elements import header_of, read_header
from sigmasplat.files.reading import open_binary
from sigmasplat.run_folder.splat_values import SH_C0, check_finite, check_values
from sigmasplat.uncertainty.map_uncertainty import SplatStd

PLY_COLUMNS: dict[str, list[str]] = {
    "means": ["x", "y", "z"],
    "quats": [f"rot_{i}" for i in range(4)],
    "log_scales": [f"scale_{i}" for i in range(3)],
    "opacity_logits": ["opacity"],
    "colors": [f"f_dc_{i}" for i in range(3)],
    "log_variances": [f"log_variance_{i}" for i in range(3)],
}
BEFORE_HARMONICS = [*PLY_COLUMNS["means"], "nx", "ny", "nz", *PLY_COLUMNS["colors"]]
AFTER_HARMONICS = ["opacity", *PLY_COLUMNS["log_scales"], *PLY_COLUMNS["quats"]]
REST = "f_rest_"
STD_COLUMNS = ("depth_std_m", "color_std")
AT_ONCE = 1 << 18
"""Splats that are converted at once: the file may be larger than the memory."""


def write_field(path: Path, field: GaussianField, *, plain: bool = False, std: SplatStd | None = None) -> None:
    """Write the splats as binary little-endian 3DGS PLY atomically; `plain`: only 3DGS's 62 columns.

    `std` adds its two columns unless `plain`. Raises RunError if the file cannot be written.
    """
    known = None if plain else std
    with_harmonics = plain or "harmonics" in field.attributes
    rest = [f"{REST}{i}" for i in range(ATTRIBUTES["harmonics"] if with_harmonics else 0)]
    ours = [] if plain else [*PLY_COLUMNS["log_variances"], *(() if std is None else STD_COLUMNS)]
    names = [*BEFORE_HARMONICS, *rest, *AFTER_HARMONICS, *ours]
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(header_of(("vertex", len(field), [f"float {name}" for name in names])))
        for first in range(0, len(field), AT_ONCE):
            file.write(_rows(field, known, names, slice(first, first + AT_ONCE)).tobytes())


def _rows(field: GaussianField, std: SplatStd | None, columns: list[str], part: slice) -> NDArray[np.float32]:
    """Return some splats as rows of a file with these columns."""
    params = field.params[part].detach().cpu().numpy().astype(np.float32)
    rows, at = np.zeros((len(params), len(columns)), "<f4"), {name: i for i, name in enumerate(columns)}

    def fill(names: Sequence[str], values: NDArray[np.float32]) -> None:
        rows[:, [at[name] for name in names]] = values

    for group in (group for group, names in PLY_COLUMNS.items() if names[0] in columns):
        values = params[:, COLUMNS[group]]
        if group == "colors":
            values = ((values.astype(np.float64) - 0.5) / SH_C0).astype(np.float32)
        fill(PLY_COLUMNS[group], values)
    if "harmonics" in field.attributes:
        harmonics = field.attributes["harmonics"].params[part].detach().cpu().numpy()
        by_channel = harmonics.astype(np.float32).reshape(-1, harmonics.shape[1] // 3, 3).swapaxes(1, 2)
        fill([f"{REST}{i}" for i in range(harmonics.shape[1])], by_channel.reshape(harmonics.shape))
    if std is not None:
        fill(STD_COLUMNS, np.stack([getattr(std, name)[part].numpy() for name in STD_COLUMNS], 1))
    return rows


def read_field(path: Path) -> GaussianField:
    """Read a 3DGS PLY of SigmaSplat or another program; a missing log_variance becomes −7.

    Raises SourceError if it is missing, not a binary PLY of splats, truncated, has nan, inf or a zero quaternion, or if
    the number of f_rest columns is not 0, 9, 24 or 45.
    """
    with open_binary(path, "cannot read map") as file:
        elements = read_header(file, path)
        if not elements or elements[0].name != "vertex" or elements[0].count < 0:
            raise SourceError(f"{path}: the PLY's first element is not 'vertex', so it is not a map of splats")
        rows = elements[0].read(file, path)
    field, harmonics = GaussianField(torch.from_numpy(_params(rows, path))), _harmonics(rows, path)
    if harmonics is not None:
        field.attributes["harmonics"] = Rows(torch.from_numpy(harmonics))
    return field


def _harmonics(rows: NDArray[np.void], path: Path) -> NDArray[np.float32] | None:
    """Return harmonics [N, 45] from f_rest, 0 above the file's degree; None if there are none. Raises SourceError."""
    given = sum(name.startswith(REST) for name in rows.dtype.names or ())
    names, each = [f"{REST}{i}" for i in range(given)], given // 3
    if not names:
        return None
    known = [3 * count(degree) for degree in range(1, DEGREES + 1)]
    if given not in known or not set(names) <= set(rows.dtype.names or ()):
        raise SourceError(f"{path} has {given} columns f_rest, expected 0 or f_rest_0 to 8, 23 or 44 (degree 1 to 3)")
    harmonics = np.zeros((len(rows), ATTRIBUTES["harmonics"]), np.float32)
    for i, name in enumerate(names):
        harmonics[:, 3 * (i % each) + i // each] = rows[name]
    check_finite(harmonics, path)
    return harmonics


def _params(rows: NDArray[np.void], path: Path) -> NDArray[np.float32]:
    """Return a field's parameters [N, 17] from the rows of a PLY. Raises SourceError on missing or invalid values."""
    present = set(rows.dtype.names or ())
    required = [name for group, names in PLY_COLUMNS.items() if group != "log_variances" for name in names]
    missing = [name for name in required if name not in present]
    if missing:
        columns = ", ".join(missing)
        raise SourceError(f"{path} is not a map of splats: no column {columns} (compressed, or a point cloud?)")
    params = np.full((len(rows), 17), INITIAL_LOG_VARIANCE, np.float32)
    for group, names in PLY_COLUMNS.items():
        for column, name in zip(range(17)[COLUMNS[group]], names, strict=True):
            if name in present:
                params[:, column] = rows[name]
    params[:, COLUMNS["colors"]] = params[:, COLUMNS["colors"]] * SH_C0 + 0.5
    check_values(params, path)
    return params
