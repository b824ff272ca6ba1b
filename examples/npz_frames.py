"""Read a folder of .npz files as an RGB-D sequence: a complete dataset format in one file.

camera.npz      width, height, fx, fy, cx, cy
000000.npz …    t (seconds), color (uint8 [H, W, 3]), depth_m (float [H, W], 0 = no reading); T_world_camera if known

`sigmasplat run FOLDER --plugin examples/npz_frames.py` reads the format. In src/sigmasplat/plugins/sources/ this file
needs no --plugin.
"""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from sigmasplat.api import (
    Camera,
    Frame,
    InputConfig,
    Source,
    SourceError,
    SourceFormat,
    Trajectory,
    color_from_bytes,
)


def read(path: Path) -> dict[str, Any]:
    """Read the arrays of one file. Raises SourceError naming it if it is damaged."""
    try:
        with np.load(path) as arrays:
            return dict(arrays)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as problem:
        raise SourceError(f"{path}: not a readable .npz ({problem}); write it again") from problem


class NpzFrames(Source):
    """A sequence with one frame per file, in the order of the names."""

    def __init__(self, folder: Path, settings: InputConfig) -> None:
        """Open a folder. Raises SourceError if the camera cannot be read or there are no frames."""
        c = read(folder / "camera.npz")
        camera = Camera(int(c["width"]), int(c["height"]), *(float(c[name]) for name in ("fx", "fy", "cx", "cy")))
        super().__init__(folder.resolve().name, camera, settings.strict)
        self._paths = sorted(path for path in folder.glob("*.npz") if path.stem.isdigit())
        if not self._paths:
            raise SourceError(f"no frames in {folder} (looked for 000000.npz and so on)")

    def __len__(self) -> int:
        return len(self._paths)

    def frame(self, i: int) -> Frame:
        """Read frame i; `Frame` refuses different sizes, NaN and negative depth."""
        arrays = read(self._paths[self._checked_index(i)])
        depth_m = arrays["depth_m"].astype(np.float32)
        return Frame(i, float(arrays["t"]), color_from_bytes(arrays["color"]), depth_m, self.camera)

    def truth(self) -> Trajectory | None:
        """Return the recorded poses; None if a frame has no pose."""
        arrays = [read(path) for path in self._paths]
        if not all("T_world_camera" in frame for frame in arrays):
            return None
        times_s = np.array([float(frame["t"]) for frame in arrays])
        return Trajectory(times_s, np.stack([frame["T_world_camera"] for frame in arrays]).astype(np.float64))


PLUGIN = SourceFormat(
    "npz frames",
    "camera.npz and 000000.npz",
    lambda path: (Path(path) / "camera.npz").is_file(),
    lambda path, settings: NpzFrames(Path(path), settings),
)
