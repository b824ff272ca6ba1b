"""Turn a field into what a browser draws: centres, covariances, colours, opacities; choose and colour splats by σ."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.drawing import colormap
from sigmasplat.model import harmonics, se3
from sigmasplat.model.field import COLUMNS, EXTRAS, GaussianField, left_factor, quaternion_of, transformed
from sigmasplat.viewer.snapshot import Piece, to_look_at

Colouring = Literal["colour", "σ"]
Floats = NDArray[np.float32]

SEEN_OPACITY = 0.1
"""Fainter splats do not count where a range of σ is looked for."""


@dataclass(frozen=True, eq=False)
class Splats:
    """N splats to draw: centers [N, 3] m and covariances [N, 3, 3] m² in the piece's frame, colors [N, 3] uint8,
    opacities [N]."""

    centers: Floats
    covariances: Floats
    colors: colormap.Rgb
    opacities: Floats

    def __len__(self) -> int:
        return len(self.centers)


@dataclass(frozen=True)
class Cut:
    """What is hidden: splats whose σ is above `most_sigma`, and those fainter than `least_opacity`."""

    most_sigma: float = float("inf")
    least_opacity: float = 0.0

    def keeps(self, field: GaussianField) -> Tensor:
        """Tell which splats are shown, bool [N]."""
        return (torch.from_numpy(sigma_of(field)) <= self.most_sigma) & (field.opacities >= self.least_opacity)


def sigma_of(field: GaussianField) -> Floats:
    """Return σ of each splat [N]: the root of the mean of σ² over the channels, in colour steps (VarSplat §1)."""
    return np.asarray(field.variances.mean(1).sqrt(), np.float32)


def sigmas(pieces: Sequence[Piece]) -> Floats:
    """Return σ, growing, of all splats that can be seen; of all there are if none can."""
    found = [sigma_of(piece.field)[(piece.field.opacities >= SEEN_OPACITY).numpy()] for piece in pieces]
    if not sum(map(len, found)):
        found = [sigma_of(piece.field) for piece in pieces]
    return np.sort(np.concatenate([np.empty(0, np.float32), *found]))


def cut_of(ordered: Floats, hidden_share: float, least_opacity: float) -> Cut:
    """Return the cut that hides this share of the splats, those of the largest σ; `ordered` as `sigmas` gives it."""
    if hidden_share <= 0.0 or not len(ordered):
        return Cut(least_opacity=least_opacity)
    return Cut(float(np.quantile(ordered, max(1.0 - hidden_share, 0.0))), least_opacity)


def sigma_span(ordered: Floats) -> tuple[float, float]:
    """Return the range of σ that the palette is spread over: from 0 to all but the extremes."""
    return 0.0, colormap.value_range(ordered, np.ones(len(ordered), bool))[1]


def splats_of(field: GaussianField, colouring: Colouring, span: tuple[float, float], cut: Cut) -> Splats:
    """Return the splats that the cut keeps, in their own colours or in those of σ over `span`."""
    kept = cut.keeps(field)
    chosen = to_look_at(field.params[kept], {})
    if colouring == "σ":
        colors = colormap.apply(sigma_of(chosen), *span, colormap.INFERNO)
    else:
        colors = np.asarray((chosen.colors.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8))
    return Splats(
        chosen.means.numpy(), covariances(chosen.quats.numpy(), chosen.scales.numpy()), colors, chosen.opacities.numpy()
    )


def covariances(quats_wxyz: Floats, scales: Floats) -> Floats:
    """Return R diag(s²) Rᵀ [N, 3, 3] of rotations [N, 4], w first, any norm, and scales s [N, 3] m."""
    spread = se3.rotation_from_quaternion(np.asarray(quats_wxyz, np.float64)) * scales[:, None, :]
    return np.asarray(spread @ spread.transpose(0, 2, 1), np.float32)


def joined(pieces: Sequence[Piece], cut: Cut) -> GaussianField:
    """Return the splats of all pieces that the cut keeps, in the world."""
    parts = [(piece, cut.keeps(piece.field)) for piece in pieces]
    params = [piece.field.params[kept] for piece, kept in parts] or [GaussianField.empty().params]
    names = {name for piece, _ in parts for name in piece.field.extras}
    extras: dict[str, list[Tensor]] = {name: [] for name in sorted(names)}
    for (piece, kept), rows in zip(parts, params, strict=False):
        T = torch.from_numpy(piece.T_world_piece).to(rows)
        _move(rows, T)
        for name, all_rows in extras.items():
            all_rows.append(_moved_extra(piece.field, name, T)[kept])
    return to_look_at(torch.cat(params), {name: torch.cat(all_rows) for name, all_rows in extras.items()})


def _move(params: Tensor, T_world_piece: Tensor) -> None:
    """Carry parameter rows to the world, in place: `GaussianField.moved` without the optimiser's state."""
    means, quats, R = params[:, COLUMNS["means"]], params[:, COLUMNS["quats"]], T_world_piece[:3, :3]
    params[:, COLUMNS["means"]] = transformed(means, R) + T_world_piece[:3, 3]
    params[:, COLUMNS["quats"]] = transformed(quats, left_factor(quaternion_of(R)))


def _moved_extra(field: GaussianField, name: str, T_world_piece: Tensor) -> Tensor:
    """Return what splats carry besides in the world, 0 where this piece has none of it."""
    if name not in field.extras:
        return field.params.new_zeros(len(field), EXTRAS[name])
    values = field.extras[name].params
    return harmonics.turned(values, T_world_piece[:3, :3]) if name == "harmonics" else values
