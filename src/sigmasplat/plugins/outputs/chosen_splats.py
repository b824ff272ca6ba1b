"""Write the splats of a run or of a map file: those within given bounds, in given axes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from sigmasplat.data.field import GaussianField
from sigmasplat.data.map_uncertainty import SplatStd
from sigmasplat.errors import ConfigError, RunError, SigmaSplatError
from sigmasplat.plugins.outputs.axes import Axes, levelled, transform_to
from sigmasplat.plugins.outputs.rendered_weight import heaviest
from sigmasplat.plugins.outputs.splat_filter import FilterResult, filter_splats, has_learned_variance, sigmas
from sigmasplat.types import Matrix

if TYPE_CHECKING:
    from sigmasplat.plugins.outputs.source import ExportSource

Y_UP_FORMATS: tuple[Axes, ...] = ("y-up", "camera")
"""The axes of formats that define y as up. `camera` is not levelled, only rotated by 180° about x."""
HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class SplatChoice:
    """Options of the command line: bounds of σ, of the standard deviation of depth (m) and of opacity, the largest
    number of splats, and the axes; None sets no bound and selects the axes of the format."""

    sigma_below: float | None
    std_below_m: float | None
    opacity_above: float | None
    max_splats: int | None
    axes: Axes | None

    @property
    def bounds(self) -> dict[str, float | None]:
        """Return the bounds by name."""
        return {name: getattr(self, name) for name in ("sigma_below", "std_below_m", "opacity_above")}

    def check(self) -> None:
        """Raise ConfigError at the first bound without a meaning."""
        for name, bound in self.bounds.items():
            if bound is not None and not 0.0 <= bound < float("inf"):
                raise ConfigError(f"--{name.replace('_', '-')} must be finite and not negative, found {bound}")
        if self.max_splats is not None and self.max_splats < 1:
            raise ConfigError(f"--max-splats must be at least 1, found {self.max_splats}")


@dataclass(frozen=True)
class SplatTarget:
    """How a format is written: the function, the format's own axes, and the axes that it can have.

    write(field, std): the field has the axes of the file, or, if the format defines y as up, those rotated by 180°
    about x, because the writers in `io.splats` rotate back.
    """

    write: Callable[[GaussianField, SplatStd | None], None]
    own: Axes
    allowed: tuple[Axes, ...]

    @property
    def turns(self) -> bool:
        """Return whether the writer rotates by 180° about x."""
        return self.own == "y-up"


def write_splats(source: "ExportSource", choice: SplatChoice, target: SplatTarget) -> str:
    """Write the splats within the bounds; return how many were written and dropped, and the axes.

    Raises ConfigError on a meaningless bound, on axes that the format cannot have, or if the splats lack the value that
    is bounded; RunError if no splat is left.
    """
    choice.check()
    axes = choice.axes or target.own
    if axes not in target.allowed:
        raise ConfigError(f"--axes {axes} cannot be used with this format, only {', '.join(target.allowed)}")
    field, std = source.splats()
    result, total = _filtered(source, field, std, choice)
    field.keep(result.kept)
    std = None if std is None else std.at(result.kept.cpu())
    if choice.max_splats is not None and len(field) > choice.max_splats:
        kept = heaviest(source.reader(), field, choice.max_splats)
        field.keep(kept)
        std = None if std is None else std.at(kept.cpu())
    T, note = _transform(source, axes, target)
    field = field if np.array_equal(T, np.eye(4)) else field.moved(torch.from_numpy(T))
    print(f"writing {len(field):,} splats …", flush=True)
    target.write(field, std)
    count = f"{len(field):,} splats, axes {axes}{note}"
    reasons = _reasons(choice, result, total - result.dropped - len(field))
    return f"{count}; dropped {total - len(field):,} of {total:,}: {reasons}" if reasons else count


def _filtered(
    source: "ExportSource", field: GaussianField, std: SplatStd | None, choice: SplatChoice
) -> tuple[FilterResult, int]:
    """Return which splats are within the bounds, and their number before."""
    path = source.path
    if choice.max_splats is not None and path.is_file():
        raise ConfigError(f"{path} is not a run, so --max-splats cannot be used; its weights need the run's path")
    if choice.sigma_below is not None and len(field) and not has_learned_variance(field):
        raise ConfigError(f"{path} has no learned σ, so --sigma-below cannot be used; give a run or its PLY")
    if choice.std_below_m is not None and std is None:
        raise ConfigError(
            f"{path} has no calibrated uncertainty, so --std-below-m cannot be used; give a run with uncertainty.json "
            "(run older runs again)"
        )
    result, total = filter_splats(field, **choice.bounds, std=std), len(field)
    if total and result.dropped == total:
        medians = f"{sigmas(field).median():.3g} and {field.opacities.median():.3g}"
        medians += "" if std is None else f", of depth_std_m {std.depth_std_m.median():.3g} m"
        raise RunError(f"no splat of {path} is left (median σ and opacity are {medians}); use weaker bounds")
    return result, total


def _reasons(choice: SplatChoice, result: FilterResult, light: int) -> str:
    """Describe how many splats were dropped for which reason; empty without a bound."""
    given = [bound is not None for bound in choice.bounds.values()]
    reasons = [f"{result.by_std:,} for the standard deviation of depth"] * (choice.std_below_m is not None)
    reasons += [f"{result.by_sigma:,} for σ, {result.by_opacity:,} for opacity"] * any(given)
    reasons += [f"{light:,} for --max-splats"] * (choice.max_splats is not None)
    return ", ".join(reasons)


def _transform(source: "ExportSource", axes: Axes, target: SplatTarget) -> tuple[Matrix, str]:
    """Return the transform [4, 4] before writing, and a note if the file is not levelled though the axes say so."""
    if axes == "camera":
        return np.eye(4), ""
    turn = HALF_TURN if target.turns else np.eye(4)
    if source.path.is_file():
        return turn @ transform_to(axes), " (a map without a path is not levelled)"
    try:
        return turn @ transform_to(axes, levelled(source.reader())), ""
    except SigmaSplatError:
        return turn @ transform_to(axes), " (not levelled: the run has no path or no images)"
