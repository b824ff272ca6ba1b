"""Write points as binary little-endian PLY: x y z (m), nx ny nz where there are normals, red green blue (bytes)."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.io.atomic import replacing

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
