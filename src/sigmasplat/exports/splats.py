"""Write the splats of a run or of a map file, without those outside of given bounds."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from sigmasplat.errors import ConfigError, RunError
from sigmasplat.model.field import GaussianField
from sigmasplat.model.map_uncertainty import SplatStd
from sigmasplat.model.splat_filter import FilterResult, filter_splats, has_learned_variance, sigmas


@dataclass(frozen=True)
class Bounds:
    """Bounds of the command line: of σ, of the standard deviation of depth (m), and of opacity; None sets no bound."""

    sigma_below: float | None
    std_below_m: float | None
    opacity_above: float | None

    def check(self) -> None:
        """Raise ConfigError at the first bound without a meaning."""
        for name, bound in asdict(self).items():
            if bound is not None and not 0.0 <= bound < float("inf"):
                raise ConfigError(f"--{name.replace('_', '-')} must be finite and not negative, found {bound}")

    def applied(self, field: GaussianField, std: SplatStd | None) -> FilterResult:
        """Return the splats within the bounds."""
        return filter_splats(field, **asdict(self), std=std)


def write_splats(
    path: Path,
    read: Callable[[], tuple[GaussianField, SplatStd | None]],
    bounds: Bounds,
    write: Callable[[GaussianField, SplatStd | None], None],
) -> str:
    """Write the splats within the bounds; return how many were written and dropped.

    `read` reads the splats of `path`, a run or a map. Raises ConfigError on a meaningless bound, or if the splats lack
    the value that is bounded; RunError if no splat is left.
    """
    bounds.check()
    field, std = read()
    if bounds.sigma_below is not None and len(field) and not has_learned_variance(field):
        raise ConfigError(f"{path} has no learned σ, so --sigma-below cannot be used; give a run or its PLY")
    if bounds.std_below_m is not None and std is None:
        raise ConfigError(
            f"{path} has no calibrated uncertainty, so --std-below-m cannot be used; give a run with uncertainty.json "
            "(run older runs again)"
        )
    result, total = bounds.applied(field, std), len(field)
    if total and result.dropped == total:
        medians = f"{sigmas(field).median():.3g} and {field.opacities.median():.3g}"
        medians += "" if std is None else f", of depth_std_m {std.depth_std_m.median():.3g} m"
        raise RunError(f"no splat of {path} is left (median σ and opacity are {medians}); use weaker bounds")
    field.keep(result.kept)
    print(f"writing {len(field):,} splats …", flush=True)
    write(field, None if std is None else std.at(result.kept.cpu()))
    if bounds == Bounds(None, None, None):
        return f"{len(field):,} splats"
    reasons = f"{result.by_sigma:,} for σ, {result.by_opacity:,} for opacity"
    if bounds.std_below_m is not None:
        reasons = f"{result.by_std:,} for the standard deviation of depth, {reasons}"
    return f"{len(field):,} splats; dropped {result.dropped:,} of {total:,}: {reasons}"
