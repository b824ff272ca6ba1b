"""Read and write splats as the field's standard 3DGS PLY, which SuperSplat and other viewers open.

Columns: x y z, nx ny nz (0), f_dc_0..2 = (colour − ½)/C0, f_rest_0..44 where colours depend on the direction (all
harmonics of red, of green, of blue), opacity (logit), scale_0..2 (log metres), rot_0..3 (wxyz), and ours at the end:
log_variance_0..2. Readers look columns up by name, so extra ones do no harm.
"""

from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.errors import SourceError
from sigmasplat.io.atomic import replacing
from sigmasplat.model.field import COLUMNS, EXTRAS, INITIAL_LOG_VARIANCE, GaussianField, Rows
from sigmasplat.model.harmonics import DEGREES, count

SH_C0 = 0.28209479177387814
"""Y₀₀ = 1/(2√π): the value of the constant spherical harmonic."""
MAX_HEADER_BYTES = 1 << 20

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}

PLY_COLUMNS: dict[str, list[str]] = {
    "means": ["x", "y", "z"],
    "quats": [f"rot_{i}" for i in range(4)],
    "log_scales": [f"scale_{i}" for i in range(3)],
    "opacity_logits": ["opacity"],
    "colors": [f"f_dc_{i}" for i in range(3)],
    "log_variances": [f"log_variance_{i}" for i in range(3)],
}
BEFORE_HARMONICS = [*PLY_COLUMNS["means"], "nx", "ny", "nz", *PLY_COLUMNS["colors"]]
AFTER_HARMONICS = ["opacity", *PLY_COLUMNS["log_scales"], *PLY_COLUMNS["quats"], *PLY_COLUMNS["log_variances"]]
REST = "f_rest_"


def write_field(path: Path, field: GaussianField) -> None:
    """Write the splats as binary little-endian 3DGS PLY, in one step. Raises RunError if the place is not writable."""
    params = field.params.detach().cpu().numpy().astype(np.float32)
    harmonics = _by_channel(field)
    rest = [f"{REST}{i}" for i in range(harmonics.shape[1])]
    names_in_file = [*BEFORE_HARMONICS, *rest, *AFTER_HARMONICS]
    rows = np.zeros(len(params), np.dtype([(name, "<f4") for name in names_in_file]))
    for group, names in PLY_COLUMNS.items():
        values = params[:, COLUMNS[group]]
        if group == "colors":
            values = ((values.astype(np.float64) - 0.5) / SH_C0).astype(np.float32)
        for i, name in enumerate(names):
            rows[name] = values[:, i]
    for i, name in enumerate(rest):
        rows[name] = harmonics[:, i]
    properties = "".join(f"property float {name}\n" for name in names_in_file)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.tobytes())


def _by_channel(field: GaussianField) -> NDArray[np.float32]:
    """Return a field's harmonics in the file's order [N, 45], or [N, 0]."""
    if "harmonics" not in field.extras:
        return np.empty((len(field), 0), np.float32)
    values = field.extras["harmonics"].params.detach().cpu().numpy().astype(np.float32)
    return values.reshape(len(field), -1, 3).swapaxes(1, 2).reshape(values.shape)


def read_field(path: Path) -> GaussianField:
    """Read a 3DGS PLY of ours or of another program; missing log_variance becomes −7.

    Raises SourceError if it is missing, not a binary PLY of splats, truncated, holds nan, inf or a zero quaternion, or
    f_rest of another number than 9, 24 or 45.
    """
    try:
        with path.open("rb") as file:
            row_type, count = _read_header(file, path)
            data = file.read(count * row_type.itemsize)
    except OSError as problem:
        raise SourceError(f"cannot read map {path}: {problem.strerror or problem}") from problem
    if len(data) < count * row_type.itemsize:
        size = count * row_type.itemsize
        raise SourceError(f"{path} is truncated: its header promises {count} splats = {size} bytes, found {len(data)}")
    rows = np.frombuffer(data, row_type)
    field, harmonics = GaussianField(torch.from_numpy(_params(rows, path))), _harmonics(rows, path)
    if harmonics is not None:
        field.extras["harmonics"] = Rows(torch.from_numpy(harmonics))
    return field


def _harmonics(rows: NDArray[np.void], path: Path) -> NDArray[np.float32] | None:
    """Gather harmonics [N, 45] from f_rest, which lower degrees have fewer of; None without. Raises SourceError."""
    given = sum(name.startswith(REST) for name in rows.dtype.names or ())
    names, each = [f"{REST}{i}" for i in range(given)], given // 3
    if not names:
        return None
    known = [3 * count(degree) for degree in range(1, DEGREES + 1)]
    if given not in known or not set(names) <= set(rows.dtype.names or ()):
        raise SourceError(f"{path} has {given} columns f_rest, expected 0 or f_rest_0 to 8, 23 or 44 (degree 1 to 3)")
    harmonics = np.zeros((len(rows), EXTRAS["harmonics"]), np.float32)
    for i, name in enumerate(names):
        harmonics[:, 3 * (i % each) + i // each] = rows[name]
    _refuse_not_finite(harmonics, path)
    return harmonics


def _params(rows: NDArray[np.void], path: Path) -> NDArray[np.float32]:
    """Gather a field's columns [N, 17] from the rows of a PLY. Raises SourceError on missing or unusable values."""
    present = set(rows.dtype.names or ())
    required = [name for group, names in PLY_COLUMNS.items() if group != "log_variances" for name in names]
    missing = [name for name in required if name not in present]
    if missing:
        raise SourceError(f"{path} is no map of splats: no column {', '.join(missing)} (compressed, or a point cloud?)")
    params = np.full((len(rows), 17), INITIAL_LOG_VARIANCE, np.float32)
    for group, names in PLY_COLUMNS.items():
        for column, name in zip(range(17)[COLUMNS[group]], names, strict=True):
            if name in present:
                params[:, column] = rows[name]
    params[:, COLUMNS["colors"]] = params[:, COLUMNS["colors"]] * SH_C0 + 0.5
    _check_values(params, path)
    return params


def _check_values(params: NDArray[np.float32], path: Path) -> None:
    """Raise SourceError at the first splat with nan, inf or a zero quaternion."""
    _refuse_not_finite(params, path)
    zero = np.flatnonzero(np.linalg.norm(params[:, COLUMNS["quats"]], axis=1) == 0)
    if len(zero):
        raise SourceError(f"{path}: splat {zero[0]} has a zero quaternion, which is no rotation")


def _refuse_not_finite(values: NDArray[np.float32], path: Path) -> None:
    bad = np.flatnonzero(~np.isfinite(values).all(1))
    if len(bad):
        raise SourceError(f"{path}: splat {bad[0]} holds nan or inf ({len(bad)} of {len(values)} splats do)")


def _read_header(file: BinaryIO, path: Path) -> tuple[np.dtype[np.void], int]:
    """Read up to end_header: the type of a row and the number of rows. Raises SourceError if it is no such PLY."""
    if file.readline(8).strip() != b"ply":
        raise SourceError(f"{path} is not a PLY file (its first line is not 'ply')")
    lines = _header_lines(file, path)
    order = BYTE_ORDERS.get(lines[0][1]) if lines and lines[0][0] == "format" and len(lines[0]) > 1 else None
    if order is None:
        found = " ".join(lines[0]) if lines else "no format"
        raise SourceError(f"{path}: the PLY is not binary ({found}); save it as binary")
    elements = [line for line in lines if line[0] == "element"]
    if not elements or elements[0][1:2] != ["vertex"] or not elements[0][-1].isdigit():
        raise SourceError(f"{path}: the PLY's first element is not 'vertex', so it is not a map of splats")
    first = lines.index(elements[0])
    end = lines.index(elements[1]) if len(elements) > 1 else len(lines)
    fields = [line[1:] for line in lines[first:end] if line[0] == "property"]
    unknown = [" ".join(words) for words in fields if len(words) != 2 or words[0] not in PLY_TYPES]
    names = [words[-1] for words in fields]
    if unknown or len(set(names)) < len(names):
        raise SourceError(f"{path}: cannot read the PLY's properties ({', '.join(unknown) or 'a name occurs twice'})")
    return np.dtype([(name, order + PLY_TYPES[kind]) for kind, name in fields]), int(elements[0][-1])


def _header_lines(file: BinaryIO, path: Path) -> list[list[str]]:
    """Return the words of each header line but comments. Raises SourceError if end_header does not come."""
    lines: list[list[str]] = []
    while file.tell() < MAX_HEADER_BYTES and (raw := file.readline(MAX_HEADER_BYTES)):
        words = raw.decode("ascii", "replace").split()
        if words == ["end_header"]:
            return lines
        if words and words[0] not in ("comment", "obj_info"):
            lines.append(words)
    raise SourceError(f"{path} is truncated: the PLY's header has no 'end_header'")
