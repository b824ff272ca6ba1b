"""List the formats of `sigmasplat export`. A new format is one function and one row of `PLUGIN`, at the end.

Imports that load torch are inside the functions, so that `sigmasplat export --help` is fast.
"""

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.api import ConfigError, Output
from sigmasplat.plugins.outputs.source import ExportSource as ExportSource

if TYPE_CHECKING:
    from sigmasplat.api import GaussianField, SplatStd
    from sigmasplat.plugins.outputs.axes import Axes, Edge


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
            known = ", ".join(row.name for row in formats)
            raise ConfigError(f"no format '{name}'; there are {known}; --plugin FILE.py adds others")
        return named[0]
    if out is None:
        return formats[0]
    endings = owners(formats)
    fitting = [ending for ending in endings if out.name.lower().endswith(ending)]
    if not fitting:
        known = ", ".join(endings)
        raise ConfigError(f"unknown ending of {out}; end it in {known}, or give --format; --plugin FILE.py adds others")
    return endings[max(fitting, key=len)]


def refuse_unused(chosen: Output, formats: tuple[Output, ...], given: list[str]) -> None:
    """Raise ConfigError if an option is given that the format does not accept."""
    for option in given:
        if not chosen.accepts(option):
            others = ", ".join(row.name for row in formats if row.accepts(option))
            raise ConfigError(
                f"--{option.replace('_', '-')} cannot be used with format {chosen.name}, only with {others}"
            )


def _spz(source: ExportSource, target: Path, *, std_below_m: float | None, axes: "Axes | None", up: "Edge") -> str:
    from sigmasplat.plugins.outputs.chosen_splats import write_splats
    from sigmasplat.plugins.outputs.spz import write_field

    return write_splats(source, "y-up", lambda field, std: write_field(target, field), std_below_m, axes, up)


def _ply(
    source: ExportSource, target: Path, *, std_below_m: float | None, axes: "Axes | None", up: "Edge", plain: bool
) -> str:
    from sigmasplat.api import splat_ply
    from sigmasplat.plugins.outputs.chosen_splats import write_splats

    def write(field: "GaussianField", std: "SplatStd | None") -> None:
        splat_ply.write_field(target, field, plain=plain, std=std)

    return write_splats(source, "y-down", write, std_below_m, axes, up)


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


def _colmap(source: ExportSource, target: Path, *, pictures: bool) -> str:
    from sigmasplat.api import Screen, no_progress
    from sigmasplat.plugins.outputs.colmap import export_colmap

    reader = source.reader()
    with Screen().counting("pictures") if pictures else nullcontext(no_progress) as progress:
        count = export_colmap(reader, target, pictures, progress)
    what = " with their pictures" if pictures else ", no pictures (--pictures)"
    return f"{count:,} views{what}{reader.left_out(keyframes=pictures)}"


def _video(
    source: ExportSource, target: Path, *, size: int, fps: float, seconds: float | None, path: str, panels: str,
    up: "Edge", std_below_m: float | None, uncertain: bool,
) -> str:  # fmt: skip
    from sigmasplat.api import Screen
    from sigmasplat.plugins.outputs.video import export_video

    with Screen().counting("film") as progress:
        count = export_video(
            source.reader(), target, width_px=size, fps=fps, seconds=seconds, orbit=path == "orbit",
            panels=panels == "all", up=up, std_below_m=std_below_m, uncertain=uncertain, progress=progress,
        )  # fmt: skip
    return f"{count:,} images, {count / fps:.1f} s"


def _plan(source: ExportSource, target: Path, *, cell_m: float, up: "Edge") -> str:
    from sigmasplat.api import Screen
    from sigmasplat.plugins.outputs.floorplan.floor_plan import FREE
    from sigmasplat.plugins.outputs.floorplan.picture import export_plan

    with Screen().counting("floor plan") as progress:
        plan = export_plan(source.reader(), target, cell_m=cell_m, up=up, progress=progress)
    return f"{plan.area_m2(FREE):.1f} m² of free floor, also in {target.with_suffix('.json').name}"


def _page(source: ExportSource, target: Path, *, up: "Edge") -> str:
    from sigmasplat.plugins.outputs.share.page import export_page

    return export_page(source.reader(), target, up)


PLUGIN = (
    Output("ply", (".ply",), "3DGS PLY with σ², for every viewer", _ply),
    Output("spz", (".spz",), "Niantic's SPZ, an eighth of the size", _spz),
    Output("trajectory", (".txt",), "the path as TUM text", _trajectory),
    Output("covariance", (".cov.txt",), "the path as TUM text with the covariance of each pose", _covariance),
    Output("colmap", ("-colmap",), "a folder with COLMAP's text model in sparse/0", _colmap),
    Output("video", (".mp4",), "a video: colour, depth, uncertainty", _video),
    Output("plan", (".plan.png", ".png"), "a floor plan", _plan),
    Output("html", (".html",), "one page for any browser, offline (sigmasplat share)", _page),
)
"""The formats of this package. The first one is the default."""
