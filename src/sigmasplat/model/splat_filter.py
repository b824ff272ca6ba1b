"""Select the reliable splats of a map: those with a small σ and a high opacity."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sigmasplat.model.field import COLUMNS, INITIAL_LOG_VARIANCE, GaussianField


@dataclass(frozen=True)
class FilterResult:
    """The mask of the kept splats, bool [N]; the number of splats dropped for their σ; the number dropped only for
    their opacity."""

    kept: Tensor
    by_sigma: int
    by_opacity: int

    @property
    def dropped(self) -> int:
        """Return the number of dropped splats."""
        return self.by_sigma + self.by_opacity


def sigmas(field: GaussianField) -> Tensor:
    """Return σ of each splat [N]: the root of σ² averaged over the colour channels, for colours in [0, 1]."""
    return field.variances.mean(1).sqrt()


def has_learned_variance(field: GaussianField) -> bool:
    """Return whether any σ² differs from its initial value. Maps read from files without σ² have this value too."""
    return bool((field.params[:, COLUMNS["log_variances"]] != INITIAL_LOG_VARIANCE).any())


def filter_splats(
    field: GaussianField, *, sigma_below: float | None = None, opacity_above: float | None = None
) -> FilterResult:
    """Select splats with σ < `sigma_below` and opacity > `opacity_above`; None sets no bound."""
    every = torch.ones(len(field), dtype=torch.bool, device=field.params.device)
    certain = every if sigma_below is None else sigmas(field) < sigma_below
    opaque = every if opacity_above is None else field.opacities > opacity_above
    return FilterResult(certain & opaque, int((~certain).sum()), int((certain & ~opaque).sum()))
