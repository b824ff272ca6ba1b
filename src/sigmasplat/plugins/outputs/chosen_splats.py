"""Write the splats of a run or of a map file that are within bounds, in given axes."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from sigmasplat.api import ConfigError, GaussianField, Matrix, RunError, SigmaSplatError, SplatStd
from sigmasplat.plugins.outputs.axes import AXES, Axes, Edge, levelled, transform_to

if TYPE_CHECKING:
    from sigmasplat.plugins.outputs.source import ExportSource


Y_UP_FORMATS: tuple[Axes, ...] = ("y-up", "camera")
"""The axes of formats that define y as up. `camera` is not levelled, only rotated by 180° about x."""
HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
WriteSplats = Callable[[GaussianField, SplatStd | None], None]


def write_splats(
    source: "ExportSource",
    own: Axes,
    write: WriteSplats,
    std_below_m: float | None,
    axes: Axes | None,
    up: Edge = "auto",
) -> str:
    """Write the splats whose standard deviation of depth (m) is below a bound, if there is one; return how many were
    written and dropped, and the axes.

    own: the axes of the format, used without `axes`. If it defines y as up, the field that `write` gets is rotated by
    180° about x, because the writer rotates it back. up: as of `levelled`. Raises ConfigError on axes that the format
    cannot have, or if the splats lack the value that is bounded; RunError if no splat is left.
    """
    axes, allowed = axes or own, Y_UP_FORMATS if own == "y-up" else AXES
    if axes not in allowed:
        raise ConfigError(f"--axes {axes} cannot be used with this format, only {', '.join(allowed)}")
    field, std = source.splats()
    total = len(field)
    if std_below_m is not None:
        kept = kept_below(source.path, std, std_below_m)
        field.keep(kept.to(field.params.device))
        std = std and std.at(kept.cpu())
    T, note = _transform(source, axes, own, up)
    field = field if np.array_equal(T, np.eye(4)) else field.moved(torch.from_numpy(T))
    print(f"writing {len(field):,} splats …", flush=True)
    write(field, std)
    dropped = "" if std_below_m is None else f"; dropped {total - len(field):,} of {total:,}"
    return f"{len(field):,} splats, axes {axes}{note}{dropped}"


def kept_below(path: Path, std: SplatStd | None, std_below_m: float) -> Tensor:
    """Return which splats of a run or map at `path` have a standard deviation of depth below a bound, bool [N].

    Raises ConfigError if it is not known, RunError if no splat has.
    """
    if std is None:
        raise ConfigError(
            f"{path} has no calibrated uncertainty, so --std-below-m cannot be used; give a run with "
            "uncertainty.json (run older runs again)"
        )
    kept = std.depth_std_m < std_below_m
    if len(kept) and not kept.any():
        median = f"{std.depth_std_m.median():.3g} m"
        raise RunError(f"no splat of {path} is left (median depth_std_m is {median}); use a weaker bound")
    return kept


def _transform(source: "ExportSource", axes: Axes, own: Axes, up: Edge) -> tuple[Matrix, str]:
    """Return the transform [4, 4] before writing, and how up was found."""
    if axes == "camera":
        return np.eye(4), ""
    turn = HALF_TURN if own == "y-up" else np.eye(4)
    if source.path.is_file():
        return turn @ transform_to(axes), " (a map without a path is not levelled)"
    try:
        R_floor_world, said, _ = levelled(source.reader(), up)
        return turn @ transform_to(axes, R_floor_world), f" ({said})"
    except SigmaSplatError:
        return turn @ transform_to(axes), " (not levelled: the run has no path or no images)"
