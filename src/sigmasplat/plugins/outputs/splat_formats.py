"""The writers of maps of splats, as rows of `exports.formats`: the options of the command line that each accepts.

Imports that load torch are inside the functions, so that `sigmasplat export --help` is fast.
"""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.errors import ConfigError

if TYPE_CHECKING:
    from sigmasplat.plugins.outputs.axes import Axes
    from sigmasplat.plugins.outputs.source import ExportSource


def ply(
    source: "ExportSource",
    target: Path,
    *,
    sigma_below: float | None,
    std_below_m: float | None,
    opacity_above: float | None,
    max_splats: int | None,
    axes: "Axes | None",
    plain: bool,
) -> str:
    """Write 3DGS PLY (`io.splats.ply`)."""
    from sigmasplat.plugins.outputs.axes import AXES
    from sigmasplat.plugins.outputs.chosen_splats import SplatChoice, SplatTarget, write_splats
    from sigmasplat.run_folder.splat_ply import write_field

    choice = SplatChoice(sigma_below, std_below_m, opacity_above, max_splats, axes)
    written = SplatTarget(lambda field, std: write_field(target, field, plain=plain, std=std), "y-down", AXES)
    return write_splats(source, choice, written)


def spz(
    source: "ExportSource",
    target: Path,
    *,
    sigma_below: float | None,
    std_below_m: float | None,
    opacity_above: float | None,
    max_splats: int | None,
    axes: "Axes | None",
    spz_version: int | None,
) -> str:
    """Write SPZ (`io.splats.spz`)."""
    from sigmasplat.plugins.outputs.chosen_splats import Y_UP_FORMATS, SplatChoice, SplatTarget, write_splats
    from sigmasplat.plugins.outputs.splats.spz import DEFAULT_VERSION, write_field
    from sigmasplat.plugins.outputs.splats.spz_container import VERSIONS

    version = DEFAULT_VERSION if spz_version is None else spz_version
    if version not in VERSIONS:
        raise ConfigError(f"--spz-version must be 2, 3 or 4, found {version}")
    choice = SplatChoice(sigma_below, std_below_m, opacity_above, max_splats, axes)
    written = SplatTarget(lambda field, _: write_field(target, field, version=version), "y-up", Y_UP_FORMATS)
    return write_splats(source, choice, written)


def like_ply(module: str) -> Callable[..., str]:
    """Return the writer of a format with the axes of PLY and without σ², made of `write_field` of io/splats/MODULE."""
    return _writer(module, scene_format=False)


def scene(module: str) -> Callable[..., str]:
    """Return the writer of a scene format, which defines y as up and keeps σ, made of io/splats/MODULE."""
    return _writer(module, scene_format=True)


def _writer(module: str, scene_format: bool) -> Callable[..., str]:
    def write(
        source: "ExportSource",
        target: Path,
        *,
        sigma_below: float | None,
        std_below_m: float | None,
        opacity_above: float | None,
        max_splats: int | None,
        axes: "Axes | None",
    ) -> str:
        from sigmasplat.plugins.outputs.axes import AXES
        from sigmasplat.plugins.outputs.chosen_splats import Y_UP_FORMATS, SplatChoice, SplatTarget, write_splats

        write_field = import_module(f"sigmasplat.plugins.outputs.splats.{module}").write_field
        choice = SplatChoice(sigma_below, std_below_m, opacity_above, max_splats, axes)
        if scene_format:
            written = SplatTarget(lambda field, std: write_field(target, field, std=std), "y-up", Y_UP_FORMATS)
        else:
            written = SplatTarget(lambda field, _: write_field(target, field), "y-down", AXES)
        return write_splats(source, choice, written)

    return write
