"""Turn a field into the arrays that a browser draws; select and colour splats by σ."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.drawing import colormap
from sigmasplat.model import harmonics, se3
from sigmasplat.model.field import ATTRIBUTES, COLUMNS, GaussianField, left_factor, quaternion_of, transformed
from sigmasplat.model.splat_filter import sigmas
from sigmasplat.viewer.snapshot import Piece, field_without_moments

Colouring = Literal["colour", "σ"]
Floats = NDArray[np.float32]

MIN_VISIBLE_OPACITY = 0.1
"""Splats with a lower opacity are ignored when the range of σ is computed."""


@dataclass(frozen=True, eq=False)
class SplatArrays:
    """N splats to draw: centers [N, 3] m and covariances [N, 3, 3] m² in the piece's frame, colors [N, 3] uint8,
    opacities [N]."""

    centers: Floats
    covariances: Floats
    colors: colormap.Rgb
    opacities: Floats

    def __len__(self) -> int:
        return len(self.centers)


@dataclass(frozen=True)
class VisibilityFilter:
    """Hides splats whose σ is above `max_sigma` or whose opacity is below `min_opacity`."""

    max_sigma: float = float("inf")
    min_opacity: float = 0.0

    def mask(self, field: GaussianField) -> Tensor:
        """Return which splats are shown, bool [N]."""
        return (sigmas(field) <= self.max_sigma) & (field.opacities >= self.min_opacity)


def sorted_sigmas(pieces: Sequence[Piece]) -> Floats:
    """Return σ of all visible splats in ascending order; of all splats if none is visible."""
    found = [sigmas(piece.field)[piece.field.opacities >= MIN_VISIBLE_OPACITY].numpy() for piece in pieces]
    if not sum(map(len, found)):
        found = [sigmas(piece.field).numpy() for piece in pieces]
    return np.sort(np.concatenate([np.empty(0, np.float32), *found]))


def visibility_filter(ordered: Floats, hidden_share: float, min_opacity: float) -> VisibilityFilter:
    """Return the filter that hides this share of the splats, those with the largest σ; `ordered` is sorted."""
    if hidden_share <= 0.0 or not len(ordered):
        return VisibilityFilter(min_opacity=min_opacity)
    return VisibilityFilter(float(np.quantile(ordered, max(1.0 - hidden_share, 0.0))), min_opacity)


def sigma_range(ordered: Floats) -> tuple[float, float]:
    """Return the range of σ that the palette covers: from 0 to a high percentile."""
    return 0.0, colormap.value_range(ordered, np.ones(len(ordered), bool))[1]


def splat_arrays(
    field: GaussianField, colouring: Colouring, span: tuple[float, float], visible: VisibilityFilter
) -> SplatArrays:
    """Return the visible splats in their own colours, or coloured by σ over the range `span`."""
    chosen = field_without_moments(field.params[visible.mask(field)], {})
    if colouring == "σ":
        colors = colormap.apply(sigmas(chosen).numpy(), *span, colormap.INFERNO)
    else:
        colors = np.asarray((chosen.colors.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8))
    return SplatArrays(
        chosen.means.numpy(), covariances(chosen.quats.numpy(), chosen.scales.numpy()), colors, chosen.opacities.numpy()
    )


def covariances(quats_wxyz: Floats, scales: Floats) -> Floats:
    """Return R diag(s²) Rᵀ [N, 3, 3] for quaternions [N, 4] wxyz of any norm and scales s [N, 3] m."""
    spread = se3.rotation_from_quaternion(np.asarray(quats_wxyz, np.float64)) * scales[:, None, :]
    return np.asarray(spread @ spread.transpose(0, 2, 1), np.float32)


def merge_pieces(pieces: Sequence[Piece], visible: VisibilityFilter) -> GaussianField:
    """Return the visible splats of all pieces as one field in the world frame."""
    parts = [(piece, visible.mask(piece.field)) for piece in pieces]
    params = [piece.field.params[kept] for piece, kept in parts] or [GaussianField.empty().params]
    names = {name for piece, _ in parts for name in piece.field.attributes}
    attributes: dict[str, list[Tensor]] = {name: [] for name in sorted(names)}
    for (piece, kept), rows in zip(parts, params, strict=False):
        T = torch.from_numpy(piece.T_world_piece).to(rows)
        _move(rows, T)
        for name, all_rows in attributes.items():
            all_rows.append(_moved_extra(piece.field, name, T)[kept])
    return field_without_moments(
        torch.cat(params), {name: torch.cat(all_rows) for name, all_rows in attributes.items()}
    )


def _move(params: Tensor, T_world_piece: Tensor) -> None:
    """Transform parameter rows to the world in place: `GaussianField.moved` without the optimiser's state."""
    means, quats, R = params[:, COLUMNS["means"]], params[:, COLUMNS["quats"]], T_world_piece[:3, :3]
    params[:, COLUMNS["means"]] = transformed(means, R) + T_world_piece[:3, 3]
    params[:, COLUMNS["quats"]] = transformed(quats, left_factor(quaternion_of(R)))


def _moved_extra(field: GaussianField, name: str, T_world_piece: Tensor) -> Tensor:
    """Return an attribute of the splats in the world frame; zeros if this piece does not have it."""
    if name not in field.attributes:
        return field.params.new_zeros(len(field), ATTRIBUTES[name])
    values = field.attributes[name].params
    return harmonics.turned(values, T_world_piece[:3, :3]) if name == "harmonics" else values
