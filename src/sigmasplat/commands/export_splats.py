"""Export maps of splats: rows of the table of `sigmasplat export`."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.commands.export_formats import ExportOptions, Format, Origin
from sigmasplat.errors import ConfigError, RunError

if TYPE_CHECKING:
    from sigmasplat.model.field import GaussianField

BOUNDS = ("sigma_below", "opacity_above")


def _ply(origin: Origin, target: Path, options: ExportOptions) -> str:
    from sigmasplat.io.splats import ply

    return _written(origin, options, lambda field: ply.write_field(target, field, plain=options.plain))


def _compressed_ply(origin: Origin, target: Path, options: ExportOptions) -> str:
    from sigmasplat.io.splats import compressed_ply

    return _written(origin, options, lambda field: compressed_ply.write_field(target, field))


def _splat(origin: Origin, target: Path, options: ExportOptions) -> str:
    from sigmasplat.io.splats import splat

    return _written(origin, options, lambda field: splat.write_field(target, field))


def _spz(origin: Origin, target: Path, options: ExportOptions) -> str:
    from sigmasplat.io.splats import spz

    return _written(origin, options, lambda field: spz.write_field(target, field))


SPLATS = (
    Format("ply", (".ply",), "3DGS PLY with σ², for every viewer", _ply, (*BOUNDS, "plain")),
    Format("compressed-ply", (".compressed.ply",), "SuperSplat's, a fifth of the size", _compressed_ply, BOUNDS),
    Format("splat", (".splat",), "32 bytes a splat, for web viewers", _splat, BOUNDS),
    Format("spz", (".spz",), "Niantic's, under a fifth of the size", _spz, BOUNDS),
)


def _written(origin: Origin, options: ExportOptions, write: "Callable[[GaussianField], None]") -> str:
    """Write the map without its doubtful splats; say how many there are and how many were dropped.

    Raises ConfigError on a bound that makes no sense, RunError where nothing is left.
    """
    from sigmasplat.model import splat_filter

    for name in BOUNDS:
        bound = getattr(options, name)
        if bound is not None and not 0.0 <= bound < float("inf"):
            raise ConfigError(f"--{name.replace('_', '-')} must be finite and not negative, found {bound}")
    field = origin.field()
    if options.sigma_below is not None and len(field) and not splat_filter.has_learned_variance(field):
        raise ConfigError(
            f"{origin.path} holds no σ that --sigma-below could judge by; only our runs and our PLY have it"
        )
    kept, every = (
        splat_filter.filter_splats(field, sigma_below=options.sigma_below, opacity_above=options.opacity_above),
        len(field),
    )
    if every and kept.dropped == every:
        medians = f"{splat_filter.sigmas(field).median():.3g} and {field.opacities.median():.3g}"
        raise RunError(f"no splat of {origin.path} is left (median σ and opacity are {medians}); give milder bounds")
    field.keep(kept.kept)
    print(f"writing {len(field):,} splats …", flush=True)
    write(field)
    asked = options.sigma_below is not None or options.opacity_above is not None
    dropped = f"; dropped {kept.dropped:,} of {every:,}: {kept.by_sigma:,} for σ, {kept.by_opacity:,} for opacity"
    return f"{len(field):,} splats" + (dropped if asked else "")
