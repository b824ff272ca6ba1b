"""Write a run's surface as points with normals and colours; sample points from a map."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.field import GaussianField
from sigmasplat.data.mesh import Mesh
from sigmasplat.files.atomic import replacing
from sigmasplat.plugins.outputs.meshes.mesh_files import color_bytes
from sigmasplat.types import Matrix

Points = NDArray[np.floating]

MAX_POINTS = 100_000
MIN_OPACITY = 0.5


def export_points(surface: Mesh, target: Path) -> int:
    """Write the vertices of a run's surface (`FusionInput.surface`), about one per voxel; return their number.

    Raises RunError if the file cannot be written.
    """
    colors = surface.vertices * 0.0 + 0.7 if surface.colors is None else surface.colors
    write_points(target, surface.vertices, colors, surface.normals(), surface.depth_std_m)
    return len(surface.vertices)


def splat_points(field: GaussianField, most: int = MAX_POINTS) -> tuple[Matrix, Matrix]:
    """Return the centres [P, 3] m and colours [P, 3] of the opaque splats, evenly thinned to `most`."""
    rows = np.flatnonzero(field.opacities.numpy() >= MIN_OPACITY)
    rows = rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)]
    return field.means.numpy()[rows].astype(np.float64), field.colors.numpy()[rows].astype(np.float64)


def write_points(
    path: Path, positions: Points, colors: Points, normals: Points | None = None, depth_std_m: Points | None = None
) -> None:
    """Write a binary PLY of positions [N, 3], colors [N, 3] in [0, 1], unit normals [N, 3] and depth_std_m [N].

    Raises RunError if the file cannot be written.
    """
    floats = ["x", "y", "z"] + ([] if normals is None else ["nx", "ny", "nz"])
    values = positions if normals is None else np.concatenate([positions, normals], 1)
    columns = [(name, "<f4") for name in floats] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.zeros(len(positions), columns + ([] if depth_std_m is None else [("depth_std_m", "<f4")]))
    for i, name in enumerate(floats):
        rows[name] = values[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        rows[name] = color_bytes(colors)[:, i]
    if depth_std_m is not None:
        rows["depth_std_m"] = depth_std_m
    kinds = {name: "uchar" if rows.dtype[name].itemsize == 1 else "float" for name in rows.dtype.names or ()}
    properties = "".join(f"property {kind} {name}\n" for name, kind in kinds.items())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.tobytes())
