"""Turn fields into the plain arrays that splat files are packed from, and such arrays into fields."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.errors import SourceError
from sigmasplat.model.field import ATTRIBUTES, COLUMNS, INITIAL_LOG_VARIANCE, WIDTH, GaussianField, Rows
from sigmasplat.model.harmonics import DEGREES, count

SH_C0 = 0.28209479177387814
"""Y₀₀ = 1/(2√π): the value of the constant spherical harmonic."""
Doubles = NDArray[np.float64]
MORTON_BITS, ROUNDING = 20, 1e-6


@dataclass(frozen=True)
class SplatValues:
    """N splats as float64 arrays; what has no place in other programs' formats (σ², correlations) is not among them.

    means [N, 3] metres; quats [N, 4] unit length, wxyz; log_scales [N, 3] log metres; opacities [N] in [0, 1]; colors
    [N, 3]; harmonics [N, 3·k] of the lowest degree that holds them all, k = 0, 3, 8 or 15 of each channel, columns
    3·i + channel.
    """

    means: Doubles
    quats: Doubles
    log_scales: Doubles
    opacities: Doubles
    colors: Doubles
    harmonics: Doubles

    @staticmethod
    def of(field: GaussianField) -> "SplatValues":
        """Take the values out of a field."""
        params = field.params.detach().cpu().double()
        part = {name: params[:, columns].numpy() for name, columns in COLUMNS.items()}
        opacities = torch.sigmoid(params[:, 10]).numpy()
        return SplatValues(
            part["means"], unit(part["quats"]), part["log_scales"], opacities, part["colors"], _harmonics(field)
        )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Return the degree of the harmonics, 0 to 3."""
        return [3 * count(degree) for degree in range(DEGREES + 1)].index(self.harmonics.shape[1])

    def ordered(self, rows: NDArray[np.intp]) -> "SplatValues":
        """Return the splats chosen by an index array, in its order."""
        return SplatValues(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def field(self, path: Path) -> GaussianField:
        """Make a field of values read from `path`, with the initial σ². Raises SourceError if some are not finite."""
        params = np.full((len(self), WIDTH), INITIAL_LOG_VARIANCE, np.float32)
        for name in ("means", "quats", "log_scales", "colors"):
            params[:, COLUMNS[name]] = getattr(self, name)
        params[:, 10] = np.log(self.opacities) - np.log1p(-self.opacities)
        check_values(params, path)
        field = GaussianField(torch.from_numpy(params))
        if self.degree:
            harmonics = np.zeros((len(self), ATTRIBUTES["harmonics"]), np.float32)
            harmonics[:, : self.harmonics.shape[1]] = self.harmonics
            field.attributes["harmonics"] = Rows(torch.from_numpy(harmonics))
        return field


def _harmonics(field: GaussianField) -> Doubles:
    """Return a field's harmonics without the degrees that are 0 throughout, or no more than rounding left there."""
    if "harmonics" not in field.attributes:
        return np.empty((len(field), 0))
    values = field.attributes["harmonics"].params.detach().cpu().double().numpy()
    needed = int(np.flatnonzero((np.abs(values) > ROUNDING).any(0)).max(initial=-1)) + 1
    return values[:, : next(n for n in (3 * count(degree) for degree in range(DEGREES + 1)) if n >= needed)]


def opacity_bytes(opacities: Doubles) -> NDArray[np.uint8]:
    """Round opacities to 255ths."""
    return np.round(opacities * 255.0).astype(np.uint8)


def opacities_of(values: NDArray[np.uint8]) -> Doubles:
    """Turn 255ths into opacities; 0 and 255 become the middle of what was rounded to them, since logits are finite."""
    return np.clip(values / 255.0, 0.25 / 255.0, 1.0 - 0.25 / 255.0)


def morton_order(points: Doubles) -> NDArray[np.intp]:
    """Return the rows of points [N, 3] in Morton order: what is close in space lies close in the file."""
    if not len(points):
        return np.empty(0, np.intp)
    low = points.min(0)
    span = max(float((points.max(0) - low).max()), np.finfo(np.float64).tiny)
    cells = ((points - low) / span * ((1 << MORTON_BITS) - 1)).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def smallest_three(quats: Doubles) -> tuple[NDArray[np.intp], Doubles]:
    """Split unit quaternions [N, 4] into which component is largest [N] and the other three [N, 3], in order.

    Signs are such that the largest is positive: it then follows from the others, which lie in ±1/√2.
    """
    which = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    positive = quats * np.where(quats[rows, which] < 0.0, -1.0, 1.0)[:, None]
    return which, positive[np.arange(4) != which[:, None]].reshape(-1, 3)


def from_smallest_three(which: NDArray[np.intp], others: Doubles) -> Doubles:
    """Put unit quaternions [N, 4] together again."""
    quats: Doubles = np.empty((len(which), 4))
    quats[np.arange(4) != which[:, None]] = others.ravel()
    quats[np.arange(len(which)), which] = np.sqrt(np.maximum(1.0 - (others**2).sum(1), 0.0))
    return unit(quats)


def unit(quats: Doubles) -> Doubles:
    """Return quaternions [N, 4] of length 1."""
    lengths: Doubles = np.linalg.norm(quats, axis=1, keepdims=True)
    return quats / lengths


def check_values(params: NDArray[np.float32], path: Path) -> None:
    """Raise SourceError at the first splat with nan, inf or a zero quaternion."""
    refuse_not_finite(params, path)
    zero = np.flatnonzero(np.linalg.norm(params[:, COLUMNS["quats"]], axis=1) == 0)
    if len(zero):
        raise SourceError(f"{path}: splat {zero[0]} has a zero quaternion, which is no rotation")


def refuse_not_finite(values: NDArray[np.float32], path: Path) -> None:
    """Raise SourceError at the first splat whose row of values [N, m] holds nan or inf."""
    bad = np.flatnonzero(~np.isfinite(values).all(1))
    if len(bad):
        raise SourceError(f"{path}: splat {bad[0]} holds nan or inf ({len(bad)} of {len(values)} splats do)")
