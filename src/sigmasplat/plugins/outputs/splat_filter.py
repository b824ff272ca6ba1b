"""Select the reliable splats of a map: those with a small standard deviation and a high opacity."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sigmasplat.data.field import COLUMNS, INITIAL_LOG_VARIANCE, GaussianField
from sigmasplat.data.map_uncertainty import SplatStd
from sigmasplat.errors import SigmaSplatError


@dataclass(frozen=True)
class FilterResult:
    """The mask of the kept splats, bool [N], and the number of dropped splats by reason: σ; standard deviation of
    depth, but not σ; only opacity."""

    kept: Tensor
    by_sigma: int
    by_opacity: int
    by_std: int = 0

    @property
    def dropped(self) -> int:
        """Return the number of dropped splats."""
        return self.by_sigma + self.by_std + self.by_opacity


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
) -> FilterResult:
    """Select splats with σ < `sigma_below`, opacity > `opacity_above` and depth_std_m of `std` < `std_below_m`.

    None sets no bound. Raises SigmaSplatError on `std_below_m` without `std`.
    """
    if std_below_m is not None and std is None:
        raise SigmaSplatError("std_below_m needs the standard deviations of the splats (RunFolder.read_splat_std)")
    every = torch.ones(len(field), dtype=torch.bool, device=field.params.device)
    certain = every if sigma_below is None else sigmas(field) < sigma_below
    accurate = every if std_below_m is None or std is None else std.depth_std_m.to(every.device) < std_below_m
    opaque = every if opacity_above is None else field.opacities > opacity_above
    kept = certain & accurate
    dropped = int((~certain).sum()), int((kept & ~opaque).sum()), int((certain & ~accurate).sum())
    return FilterResult(kept & opaque, *dropped)
