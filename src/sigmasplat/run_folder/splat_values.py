"""Convert fields to the arrays that splat files are packed from, and check those that were read."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.data.field import ATTRIBUTES, COLUMNS, GaussianField
from sigmasplat.data.harmonics import DEGREES, count, turned
from sigmasplat.errors import SourceError

Doubles = NDArray[np.float64]


def unit(quats: Doubles) -> Doubles:
    """Return quaternions [N, 4] scaled to length 1."""
    lengths: Doubles = np.linalg.norm(quats, axis=1, keepdims=True)
    return quats / lengths


def smallest_three(quats: Doubles) -> tuple[NDArray[np.intp], Doubles]:
    """Split unit quaternions [N, 4] into the index of the largest component [N] and the other three [N, 3], in order.

    Signs are chosen so that the largest component is positive. It then follows from the others, which are within ±1/√2.
    """
    which = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    positive = quats * np.where(quats[rows, which] < 0.0, -1.0, 1.0)[:, None]
    return which, positive[np.arange(4) != which[:, None]].reshape(-1, 3)


SH_C0 = 0.28209479177387814
"""Y₀₀ = 1/(2√π): the constant spherical harmonic."""
R_RUB_RDF = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""Rotates axes x right, y down, z forward to x right, y up, z back, and back."""
MORTON_BITS, ROUNDING = 20, 1e-6


@dataclass(frozen=True)
class SplatValues:
    """N splats as float64 arrays, without σ², which other programs' formats cannot hold.

    means [N, 3] m; quats [N, 4] wxyz, unit length; log_scales [N, 3] log metres; opacities [N] in [0, 1]; colors [N,
    3]; harmonics [N, 3·k] of the lowest sufficient degree: k = 0, 3, 8 or 15 per channel, columns 3·i + channel.
    """

    means: Doubles
    quats: Doubles
    log_scales: Doubles
    opacities: Doubles
    colors: Doubles
    harmonics: Doubles

    @staticmethod
    def of(field: GaussianField) -> "SplatValues":
        """Return the values of a field."""
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
        """Return the splats selected by an index array, in its order."""
        return SplatValues(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def turned_about_x(self) -> "SplatValues":
        """Return the splats rotated by 180° about x: from axes x right, y down, z forward to x right, y up, z back.

        It is its own inverse. Only signs change: of means, quaternions and harmonics.
        """
        xyz = R_RUB_RDF.diagonal().numpy()
        ones = torch.ones(1, ATTRIBUTES["harmonics"], dtype=torch.float64)
        signs = turned(ones, R_RUB_RDF).round().numpy()[:, : self.harmonics.shape[1]]
        quats = self.quats * np.array([1.0, *xyz])
        return replace(self, means=self.means * xyz, quats=quats, harmonics=self.harmonics * signs)


def _harmonics(field: GaussianField) -> Doubles:
    """Return a field's harmonics without the highest degrees that are 0 up to rounding."""
    if "harmonics" not in field.attributes:
        return np.empty((len(field), 0))
    values = field.attributes["harmonics"].params.detach().cpu().double().numpy()
    needed = int(np.flatnonzero((np.abs(values) > ROUNDING).any(0)).max(initial=-1)) + 1
    return values[:, : next(n for n in (3 * count(degree) for degree in range(DEGREES + 1)) if n >= needed)]


def to_bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Round values to bytes; those outside 0 to 255 are clipped."""
    return np.clip(np.round(values), 0.0, 255.0).astype(np.uint8)


def morton_order(points: Doubles) -> NDArray[np.intp]:
    """Return the rows of points [N, 3] in Morton order: points that are close in space are close in the file."""
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


def check_values(params: NDArray[np.float32], path: Path) -> None:
    """Raise SourceError at the first splat with nan, inf or a zero quaternion."""
    check_finite(params, path)
    zero = np.flatnonzero(np.linalg.norm(params[:, COLUMNS["quats"]], axis=1) == 0)
    if len(zero):
        raise SourceError(f"{path}: splat {zero[0]} has a zero quaternion, which is not a rotation")


def check_finite(values: NDArray[np.float32], path: Path) -> None:
    """Raise SourceError at the first splat whose row of values [N, m] has nan or inf."""
    bad = np.flatnonzero(~np.isfinite(values).all(1))
    if len(bad):
        raise SourceError(f"{path}: splat {bad[0]} has nan or inf ({len(bad)} of {len(values)} splats do)")
