"""Export what is no file of splats - paths, points, films, the floor plan: rows of the table of `sigmasplat export`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.commands.export_formats import ExportOptions, Format, Origin
from sigmasplat.commands.options import prepare_torch, source_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from sigmasplat.exports import Recorded
    from sigmasplat.types import Progress

SOURCE, PICTURES = ("source",), ("source", "pictures")


def _recorded(origin: Origin, options: ExportOptions) -> "Recorded":
    from sigmasplat.exports import Recorded

    run = origin.run()
    prepare_torch()
    return Recorded(run, lambda: source_of(run, options.source))


@contextmanager
def _counting(title: str) -> "Iterator[Progress]":
    from sigmasplat.run.terminal import Screen

    with Screen().counting(title) as progress:
        yield progress


def _kitti(origin: Origin, target: Path, options: ExportOptions) -> str:
    from sigmasplat.exports import export_kitti

    return f"{export_kitti(_recorded(origin, options), target):,} poses"


def _nerfstudio(origin: Origin, target: Path, options: ExportOptions) -> str:
    from sigmasplat.exports import export_transforms

    return _views(_with_pictures(export_transforms, origin, target, options), options)


def _colmap(origin: Origin, target: Path, options: ExportOptions) -> str:
    from sigmasplat.exports import export_colmap

    return _views(_with_pictures(export_colmap, origin, target, options), options)


def _with_pictures(
    export: "Callable[[Recorded, Path, bool, Progress], int]",
    origin: Origin,
    target: Path,
    options: ExportOptions,
) -> int:
    """Export views, counting pictures where they are asked for; return how many views."""
    recorded = _recorded(origin, options)
    if not options.pictures:
        return export(recorded, target, False, lambda done, total: None)
    with _counting("pictures") as progress:
        return export(recorded, target, True, progress)


def _views(count: int, options: ExportOptions) -> str:
    return f"{count:,} views" + (" with their pictures" if options.pictures else ", no pictures (--pictures)")


def _points(origin: Origin, target: Path, options: ExportOptions) -> str:
    from sigmasplat.exports import export_points

    with _counting("surface") as progress:
        count = export_points(_recorded(origin, options), target, voxel_m=options.voxel_m, progress=progress)
    return f"{count:,} points"


def _video(origin: Origin, target: Path, options: ExportOptions) -> str:
    from sigmasplat.exports import VideoOptions, export_video

    asked = VideoOptions(options.size, options.fps, options.seconds, options.path)
    with _counting("film") as progress:
        count = export_video(_recorded(origin, options), target, asked, progress=progress)
    return f"{count:,} images, {count / options.fps:.1f} s"


def _plan(origin: Origin, target: Path, options: ExportOptions) -> str:
    from sigmasplat.exports import export_plan

    with _counting("floor plan") as progress:
        plan = export_plan(_recorded(origin, options), target, cell_m=options.cell_m, progress=progress)
    places = "nowhere to scan again" if not plan.regions else f"{len(plan.regions)} places to scan again"
    return f"{places}, also in {target.with_suffix('.json').name}"


SCENE = (
    Format("kitti", (".kitti.txt",), "the path as KITTI text, a line a frame", _kitti, SOURCE),
    Format("nerfstudio", (".json",), "views as nerfstudio's transforms.json", _nerfstudio, PICTURES),
    Format("colmap", ("-colmap",), "a folder with COLMAP's text model in sparse/0", _colmap, PICTURES),
    Format("points", (".points.ply",), "the surface as points with normals", _points, (*SOURCE, "voxel_m")),
    Format(
        "video", (".webm", ".mp4", ".gif", ".webp"), "colour, depth and uncertainty as a film", _video,
        (*SOURCE, "size", "fps", "seconds", "path"),
    ),
    Format("plan", (".plan.png", ".png"), "floor plan: where to scan again", _plan, (*SOURCE, "cell_m")),
)  # fmt: skip
