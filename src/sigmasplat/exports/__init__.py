"""Write what a run made in other programs' formats: paths, points, videos, floor plans."""

from sigmasplat.exports.paths import export_colmap, export_kitti, export_transforms
from sigmasplat.exports.plan import export_plan
from sigmasplat.exports.points import export_points
from sigmasplat.exports.recorded import Recorded
from sigmasplat.exports.video import VideoOptions, export_video

__all__ = [
    "Recorded",
    "VideoOptions",
    "export_colmap",
    "export_kitti",
    "export_plan",
    "export_points",
    "export_transforms",
    "export_video",
]
