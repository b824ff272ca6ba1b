"""Write a run's surface as points with normals and colours."""

from pathlib import Path

from sigmasplat.exports.recorded import Recorded
from sigmasplat.io.points import write_points
from sigmasplat.slam.fusion import VOXEL_M, Renderer
from sigmasplat.surface import Recording
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
    surface = Recording.at(recorded.run, recorded.camera).surface(voxel_m, renderer, progress)
    colors = surface.vertices * 0.0 + 0.7 if surface.colors is None else surface.colors
    write_points(target, surface.vertices, colors, surface.normals())
    return len(surface.vertices)
