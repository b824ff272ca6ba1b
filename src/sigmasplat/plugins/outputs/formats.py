"""List the formats of `sigmasplat export`. A new format is one function and one row of `PLUGIN`, at the end.

Imports that load torch are inside the functions, so that `sigmasplat export --help` is fast.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sigmasplat.api import ConfigError, Output
from sigmasplat.plugins.outputs.source import ExportSource as ExportSource

if TYPE_CHECKING:
    from sigmasplat.api import GaussianField, Progress, SplatStd
    from sigmasplat.plugins.outputs.axes import Axes


Bound = float | None
SPZ, SOG, GLTF = (f"sigmasplat.plugins.outputs.splats.{name}" for name in ("spz", "sog", "gltf"))


def owners(formats: tuple[Output, ...]) -> dict[str, Output]:
    """Return the format that each ending selects: the first one with that ending."""
    endings: dict[str, Output] = {}
    for row in formats:
        for ending in row.endings:
            endings.setdefault(ending, row)
    return endings


def listed(formats: tuple[Output, ...]) -> list[str]:
    """Return a line of help for each format: the endings that select it, its name and its description."""
    own = owners(formats)
    endings = (", ".join(ending for ending in row.endings if own[ending] is row) or "--format" for row in formats)
    return [f"{ending:<15} {row.name}: {row.help}" for ending, row in zip(endings, formats, strict=True)]


def choose(formats: tuple[Output, ...], name: str | None, out: Path | None) -> Output:
    """Return the format with this name, else the one that the ending of `out` selects, else the first one.

    Raises ConfigError if the name or the ending is unknown.
    """
    if name is not None:
        named = [row for row in formats if row.name == name]
        if not named:
            raise ConfigError(f"no format '{name}'; there are {', '.join(row.name for row in formats)}")
        return named[0]
    if out is None:
        return formats[0]
    endings = owners(formats)
    fitting = [ending for ending in endings if out.name.lower().endswith(ending)]
    if not fitting:
        raise ConfigError(f"unknown ending of {out}; end it in {', '.join(endings)}, or give --format")
    return endings[max(fitting, key=len)]


def refuse_unused(chosen: Output, formats: tuple[Output, ...], given: list[str]) -> None:
    """Raise ConfigError if an option is given that the format does not accept."""
    for option in given:
        if not chosen.accepts(option):
            others = ", ".join(row.name for row in formats if row.accepts(option))
            raise ConfigError(
                f"--{option.replace('_', '-')} cannot be used with format {chosen.name}, only with {others}"
            )


def _splats(
    module: str, own: "Axes", keeps_std: bool, source: ExportSource, target: Path, *, sigma_below: Bound,
    std_below_m: Bound, opacity_above: Bound, max_splats: int | None, axes: "Axes | None", **more: Any,
) -> str:  # fmt: skip
    """Write the chosen splats with `write_field` of a module; own: the axes of its format, keeps_std: it has `std`."""
    from sigmasplat.plugins.outputs.chosen_splats import write_splats

    def write(field: "GaussianField", std: "SplatStd | None") -> None:
        import_module(module).write_field(target, field, **more, **({"std": std} if keeps_std else {}))

    return write_splats(
        source, own, write, sigma_below=sigma_below, std_below_m=std_below_m, opacity_above=opacity_above,
        max_splats=max_splats, axes=axes,
    )  # fmt: skip


def _ply(
    source: ExportSource, target: Path, *, sigma_below: Bound, std_below_m: Bound, opacity_above: Bound,
    max_splats: int | None, axes: "Axes | None", plain: bool,
) -> str:  # fmt: skip
    return _splats(
        "sigmasplat.run_folder.splat_ply", "y-down", True, source, target, sigma_below=sigma_below,
        std_below_m=std_below_m, opacity_above=opacity_above, max_splats=max_splats, axes=axes, plain=plain,
    )  # fmt: skip


@contextmanager
def _counting(title: str) -> "Iterator[Progress]":
    from sigmasplat.api import Screen

    with Screen().counting(title) as progress:
        yield progress


def _trajectory(source: ExportSource, target: Path) -> str:
    from sigmasplat.api import write_trajectory

    reader = source.reader()
    has_log = (reader.run.path / "log.jsonl").is_file()
    path = reader.valid_path() if has_log else reader.run.read_trajectory()
    write_trajectory(target, path)
    return f"{len(path):,} poses{reader.left_out() if has_log else ''}"


def _covariance(source: ExportSource, target: Path) -> str:
    from sigmasplat.api import write_square

    reader = source.reader()
    path = reader.valid_path()
    write_square(target, path, reader.covariances())
    return f"{len(path):,} poses with their covariance{reader.left_out()}"


def _views(write: str, source: ExportSource, target: Path, *, pictures: bool) -> str:
    from sigmasplat.plugins.outputs import views

    reader = source.reader()
    if not pictures:
        count = getattr(views, write)(reader, target)
        return f"{count:,} views, no pictures (--pictures){reader.left_out()}"
    with _counting("pictures") as progress:
        count = getattr(views, write)(reader, target, True, progress)
        return f"{count:,} views with their pictures{reader.left_out(keyframes=True)}"


def _video(
    source: ExportSource, target: Path, *, size: int, fps: float, seconds: float | None, path: str, panels: str
) -> str:
    from sigmasplat.plugins.outputs.video import VideoOptions, export_video

    options = VideoOptions(size, fps, seconds, path, panels)  # type: ignore[arg-type]
    with _counting("film") as progress:
        count = export_video(source.reader(), target, options, progress=progress)
    return f"{count:,} images, {count / fps:.1f} s"


def _plan(source: ExportSource, target: Path, *, cell_m: float) -> str:
    from sigmasplat.plugins.outputs.floorplan.picture import export_plan

    with _counting("floor plan") as progress:
        plan = export_plan(source.reader(), target, cell_m=cell_m, progress=progress)
    regions = "no places to scan again" if not plan.regions else f"{len(plan.regions)} places to scan again"
    return f"{regions}, also in {target.with_suffix('.json').name}"


def _bag(source: ExportSource, target: Path, *, pictures: bool) -> str:
    from sigmasplat.plugins.robots.bag import export_bag

    reader = source.reader()
    with _counting("floor plan") as progress:
        counts = export_bag(reader, target, pictures=pictures, progress=progress)
    return f"{sum(counts.values()):,} messages of {len(counts)} topics{reader.left_out()}"


_nerfstudio, _colmap = (partial(_views, write) for write in ("export_nerfstudio", "export_colmap"))
PLUGIN = (
    Output("ply", (".ply",), "3DGS PLY with σ², for every viewer", _ply),
    Output("spz", (".spz",), "Niantic's SPZ, less than a fifth of the size", partial(_splats, SPZ, "y-up", False)),
    Output("sog", (".sog",), "SuperSplat's SOG, the smallest", partial(_splats, SOG, "y-down", False)),
    Output("gltf", (".glb",), "glTF with splats (KHR) and σ", partial(_splats, GLTF, "y-up", True)),
    Output("trajectory", (".txt",), "the path as TUM text", _trajectory),
    Output("covariance", (".cov.txt",), "the path as TUM text with the covariance of each pose", _covariance),
    Output("nerfstudio", (".json",), "views as nerfstudio's transforms.json", _nerfstudio, True),
    Output("colmap", ("-colmap",), "a folder with COLMAP's text model in sparse/0", _colmap, True),
    Output("video", (".webm", ".mp4", ".gif", ".webp"), "a video: colour, depth, uncertainty", _video, True),
    Output("bag", (".mcap", "-bag"), "ROS 2 messages: path with covariance, map", _bag, True),
    Output("plan", (".plan.png", ".png"), "a floor plan with regions to scan again", _plan, True),
)
"""The formats of this package. The first one is the default."""
