"""Write any source as a TUM folder."""

from pathlib import Path

from sigmasplat.data import se3
from sigmasplat.input.source import Source
from sigmasplat.plugins.sources.tum import TumWriter


def write_tum(source: Source, folder: str | Path) -> None:
    """Write PNG images, lists, calibration.json and the ground-truth path, if known. Raises as `TumWriter`."""
    writer = TumWriter(Path(folder), source.camera)
    if (truth := source.truth()) is not None:
        lines = ["# timestamp tx ty tz qx qy qz qw\n"]
        for t, T in zip(truth.timestamps_s, truth.T_world_camera, strict=True):
            w, x, y, z = se3.quaternion_from_rotation(T[:3, :3])
            lines.append(f"{t:.6f} " + " ".join(f"{v:.9f}" for v in (*T[:3, 3], x, y, z, w)) + "\n")
        (writer.folder / "groundtruth.txt").write_text("".join(lines))
    for frame in source:
        writer.add(frame)
