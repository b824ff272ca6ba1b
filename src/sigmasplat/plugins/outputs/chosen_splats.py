"""Write the splats of a run or of a map file: those within bounds or of most weight in its views, in given axes."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from sigmasplat.api import (
    COLUMNS,
    INITIAL_LOG_VARIANCE,
    ConfigError,
    GaussianField,
    Matrix,
    RunError,
    SigmaSplatError,
    SplatStd,
    blend_values,
    evenly_spread,
    on_device,
    se3,
)
from sigmasplat.plugins.outputs.axes import AXES, Axes, levelled, transform_to
from sigmasplat.plugins.outputs.run_reader import RunReader

if TYPE_CHECKING:
    from sigmasplat.plugins.outputs.source import ExportSource


def sigmas(field: GaussianField) -> Tensor:
    """Return σ of each splat [N]: the root of σ² averaged over the colour channels, for colours in [0, 1]."""
    return field.variances.mean(1).sqrt()


def has_learned_variance(field: GaussianField) -> bool:
    """Return whether any σ² differs from its initial value. Maps read from files without σ² have this value too."""
    return bool((field.params[:, COLUMNS["log_variances"]] != INITIAL_LOG_VARIANCE).any())


def filter_splats(
    field: GaussianField,
    *,
    sigma_below: float | None = None,
    opacity_above: float | None = None,
    std_below_m: float | None = None,
    std: SplatStd | None = None,
) -> Tensor:
    """Return the mask [N] of splats with σ < `sigma_below`, opacity > `opacity_above` and depth_std_m < `std_below_m`.

    None sets no bound. Raises SigmaSplatError on `std_below_m` without `std`.
    """
    if std_below_m is not None and std is None:
        raise SigmaSplatError("std_below_m needs the standard deviations of the splats (RunFolder.read_splat_std)")
    kept = torch.ones(len(field), dtype=torch.bool, device=field.params.device)
    if sigma_below is not None:
        kept &= sigmas(field) < sigma_below
    if std_below_m is not None and std is not None:
        kept &= std.depth_std_m.to(kept.device) < std_below_m
    return kept if opacity_above is None else kept & (field.opacities > opacity_above)


MOST_VIEWS = 60
"""At most this many poses of the path, evenly spread, are rendered."""


def heaviest(reader: RunReader, field: GaussianField, most: int) -> Tensor:
    """Return the mask [N] of the `most` splats with the largest rendered weight; of equal ones, the first ones.

    The rendered weight of a splat is Σ w over the pixels of a view, in the view where it is largest. A sum over all
    views would drop what few views show. Raises RunError if the run has no path.
    """
    camera, config = reader.camera, reader.config
    shown, none = on_device(field, config.backend), torch.zeros(len(field), 0)
    ones = torch.ones(camera.height, camera.width, 1)
    weights = torch.zeros(len(field))
    for T_world_camera in evenly_spread(list(reader.valid_path().T_world_camera), MOST_VIEWS):
        T = se3.inverse(T_world_camera)
        seen = blend_values(shown, camera, T, none, config.render, config.backend, gather=True)
        weights = torch.maximum(weights, seen.gather(ones.to(seen.alpha))[:, 0].cpu())
    kept = torch.zeros(len(field), dtype=torch.bool)
    kept[torch.from_numpy(np.argsort(-weights.numpy(), kind="stable")[:most].copy())] = True
    return kept.to(field.params.device)


Y_UP_FORMATS: tuple[Axes, ...] = ("y-up", "camera")
"""The axes of formats that define y as up. `camera` is not levelled, only rotated by 180° about x."""
HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
WriteSplats = Callable[[GaussianField, SplatStd | None], None]
Bound = float | None


def write_splats(
    source: "ExportSource", own: Axes, write: WriteSplats, *, sigma_below: Bound, std_below_m: Bound,
    opacity_above: Bound, max_splats: int | None, axes: Axes | None,
) -> str:  # fmt: skip
    """Write the splats within the bounds of σ, of the standard deviation of depth (m) and of opacity, and of those at
    most `max_splats`; return how many were written and dropped, and the axes. None sets no bound.

    own: the axes of the format, used without `axes`. If it defines y as up, the field that `write` gets is rotated by
    180° about x, because the writers in `splats/` rotate it back. Raises ConfigError on axes that the format cannot
    have, or if the splats lack the value that is bounded; RunError if no splat is left.
    """
    axes, allowed = axes or own, Y_UP_FORMATS if own == "y-up" else AXES
    if axes not in allowed:
        raise ConfigError(f"--axes {axes} cannot be used with this format, only {', '.join(allowed)}")
    field, std = source.splats()
    _check_known(source.path, field, std, sigma_below, std_below_m, max_splats)
    total, bounds = len(field), {"sigma_below": sigma_below, "opacity_above": opacity_above, "std_below_m": std_below_m}
    kept = filter_splats(field, **bounds, std=std)
    if total and not kept.any():
        medians = f"{sigmas(field).median():.3g} and {field.opacities.median():.3g}"
        medians += "" if std is None else f", of depth_std_m {std.depth_std_m.median():.3g} m"
        raise RunError(f"no splat of {source.path} is left (median σ and opacity are {medians}); use weaker bounds")
    if max_splats is not None and int(kept.sum()) > max_splats:
        inside = field.moved(torch.eye(4))  # makes a copy
        inside.keep(kept)
        kept[kept.nonzero()[:, 0][~heaviest(source.reader(), inside, max_splats)]] = False
    field.keep(kept)
    std = None if std is None else std.at(kept.cpu())
    T, note = _transform(source, axes, own)
    field = field if np.array_equal(T, np.eye(4)) else field.moved(torch.from_numpy(T))
    print(f"writing {len(field):,} splats …", flush=True)
    write(field, std)
    bounded = any(bound is not None for bound in (*bounds.values(), max_splats))
    dropped = f"; dropped {total - len(field):,} of {total:,}" if bounded else ""
    return f"{len(field):,} splats, axes {axes}{note}{dropped}"


def _check_known(
    path: Path, field: GaussianField, std: SplatStd | None, sigma_below: Bound, std_below_m: Bound,
    max_splats: int | None,
) -> None:  # fmt: skip
    """Raise ConfigError if the splats lack a value that is bounded."""
    if max_splats is not None and path.is_file():
        raise ConfigError(f"{path} is not a run, so --max-splats cannot be used; its weights need the run's path")
    if sigma_below is not None and len(field) and not has_learned_variance(field):
        raise ConfigError(f"{path} has no learned σ, so --sigma-below cannot be used; give a run or its PLY")
    if std_below_m is not None and std is None:
        raise ConfigError(
            f"{path} has no calibrated uncertainty, so --std-below-m cannot be used; give a run with uncertainty.json "
            "(run older runs again)"
        )


def _transform(source: "ExportSource", axes: Axes, own: Axes) -> tuple[Matrix, str]:
    """Return the transform [4, 4] before writing, and a note if the file is not levelled though the axes say so."""
    if axes == "camera":
        return np.eye(4), ""
    turn = HALF_TURN if own == "y-up" else np.eye(4)
    if source.path.is_file():
        return turn @ transform_to(axes), " (a map without a path is not levelled)"
    try:
        return turn @ transform_to(axes, levelled(source.reader())), ""
    except SigmaSplatError:
        return turn @ transform_to(axes), " (not levelled: the run has no path or no images)"
