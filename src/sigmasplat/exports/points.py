"""Write a run's surface as points with normals and colours."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.evaluation.reconstruct import FusionInput
from sigmasplat.exports.recorded import Recorded
from sigmasplat.io.atomic import replacing
from sigmasplat.slam.fusion import VOXEL_M, Renderer
from sigmasplat.types import Progress


def export_points(
    recorded: Recorded,
    target: Path,
    *,
    voxel_m: float = VOXEL_M,
    renderer: Renderer | None = None,
    progress: Progress = lambda done, total: None,
) -> int:
    """Fuse what the map shows at its keyframes and write the surface's points; return how many.

    They are the vertices of the mesh that `surface.reconstruct` makes, about one per voxel that the surface crosses.
    Raises RunError if the run has no map, checkpoint or keyframe, ConfigError unless voxel_m > 0.
    """
    surface = FusionInput.at(recorded.run, recorded.camera).surface(voxel_m, renderer, progress)
    colors = surface.vertices * 0.0 + 0.7 if surface.colors is None else surface.colors
    write_points(target, surface.vertices, colors, surface.normals())
    return len(surface.vertices)


Points = NDArray[np.floating]


def color_bytes(colors: Points) -> NDArray[np.uint8]:
    """Turn colours in [0, 1] into bytes; beyond it the ends hold."""
    return np.asarray(np.rint(np.clip(colors, 0.0, 1.0) * 255.0), np.uint8)


def write_points(path: Path, positions: Points, colors: Points, normals: Points | None = None) -> None:
    """Write positions [N, 3], colors [N, 3] in [0, 1] and unit normals [N, 3]. Raises RunError if not writable."""
    floats = ["x", "y", "z"] + ([] if normals is None else ["nx", "ny", "nz"])
    values = positions if normals is None else np.concatenate([positions, normals], 1)
    rows = np.zeros(len(positions), [(name, "<f4") for name in floats] + [(n, "u1") for n in ("red", "green", "blue")])
    for i, name in enumerate(floats):
        rows[name] = values[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        rows[name] = color_bytes(colors)[:, i]
    properties = "".join(
        f"property {'float' if name in floats else 'uchar'} {name}\n" for name in rows.dtype.names or ()
    )
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.tobytes())
