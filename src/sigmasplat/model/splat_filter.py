"""Say which splats of a map are doubtful: seldom the colour that was learnt, or hardly there."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sigmasplat.model.field import COLUMNS, INITIAL_LOG_VARIANCE, GaussianField


@dataclass(frozen=True)
class FilterResult:
    """Which splats are kept (bool mask [N]), how many are not for their σ, and how many more for their opacity."""

    rows: Tensor
    by_sigma: int
    by_opacity: int

    @property
    def dropped(self) -> int:
        """Return how many splats are not kept."""
        return self.by_sigma + self.by_opacity


def sigmas(field: GaussianField) -> Tensor:
    """Return σ of each splat [N]: the root of σ² averaged over the colour channels, colours being 0 … 1."""
    return field.variances.mean(1).sqrt()


def has_learned_variance(field: GaussianField) -> bool:
    """Say whether a map's σ² mean anything: not where each is as splats are born, or as readers fill it in."""
    return bool((field.params[:, COLUMNS["log_variances"]] != INITIAL_LOG_VARIANCE).any())


def sure(field: GaussianField, *, sigma_below: float | None = None, opacity_above: float | None = None) -> FilterResult:
    """Choose splats with σ < `sigma_below` and opacity > `opacity_above`; None asks for nothing."""
    every = torch.ones(len(field), dtype=torch.bool, device=field.params.device)
    known = every if sigma_below is None else sigmas(field) < sigma_below
    there = every if opacity_above is None else field.opacities > opacity_above
    return FilterResult(known & there, int((~known).sum()), int((known & ~there).sum()))
