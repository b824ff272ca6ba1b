"""Align two RGB-D images directly: Gauss–Newton on SE(3), coarse to fine, with gray and depth residuals together.

The reference is a keyframe's image (tracking, the graph of keyframes), a rendered map, or the last frame (odometry).
A dozen steps of 0.1 ms replace dozens of renders. Alignment runs on the device that holds the images: CPU or CUDA.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.readout import readouts
from sigmasplat.errors import BackendError
from sigmasplat.fit.interface import AlignRules, ImageKernels, LevelPlanes, Plane
from sigmasplat.fit.pyramid import LEVELS, NOISE_PER_M, Pyramid
from sigmasplat.types import Matrix

HUBER_GRAY = (0.02, 0.05, 0.1, 0.2)
"""Huber width of the gray residual per pyramid level, finest level first. It is wider on coarse levels because
residuals are large far from the solution."""
HUBER_DEPTH_RELATIVE = (0.003, 0.006, 0.012, 0.05)
"""Huber width of the depth residual per level, times z² (m), for depth with `NOISE_PER_M`; it grows with the noise. The
finest value is the noise of a structured-light sensor (Khoshelham & Elberink 2012)."""
DEPTH_GATES_M = (0.1, 0.3, 0.8, 2.0)
"""Depth residuals above this limit are assumed to belong to other surfaces; finest level first."""
MIN_PIXELS = 60
ITERATIONS, UPDATE_STOP = 15, 2e-4
"""Usual limits of an alignment: see `align`."""
DEGENERATE = 1e-5
"""A direction is undetermined if its information is below this share of the largest one."""
BIAS_PX = 0.01
"""Systematic error of an alignment, pixels. Interpolation moves an edge by up to 1/40 pixel, depending on where it lies
between two pixels (Schreier et al. 2000). The mean over an image is smaller but not zero. 1/100 pixel is the accuracy
that digital image correlation reaches in practice."""
UNKNOWN_M = 1.0
"""Standard deviation assumed for an undetermined direction, metres (for rotations: shift at the mean depth)."""
UPPER = np.triu_indices(6)
"""Rows and columns of the upper triangle of H, in the order of the kernels' sums."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """The result of an alignment: the motion T_live_reference and its quality.

    agreement: share of overlapping pixels whose depths agree; overlap: share of reference pixels that both cameras see,
    where live depth has no large hole (scattered holes do not reduce it); degenerate: number of undetermined directions
    of motion; cost: per pixel; steps: number of steps taken; depth_m: mean depth of the reference.
    """

    T_live_reference: Matrix
    agreement: float
    overlap: float
    degenerate: int
    cost: float
    steps: int
    pair: "Pair"
    depth_m: float

    @cached_property
    def covariance(self) -> Matrix:
        """Estimate the covariance [6, 6] of the left twist (ρ, φ), m and rad, on first access. It costs as much as 7
        steps in images of 240 rows.

        The result is D⁻¹ S D⁻ᵀ. S sums outer products of the gradient per cell of the image, because residuals of
        neighbouring pixels are correlated (cluster-robust sandwich estimator, Liang & Zeger 1986). D is the measured
        change of the gradient within half a pixel, by some 120 rows, which are enough. H is not used for D: it is
        computed from noisy image gradients, so it is several times too steep. An undetermined direction has the
        standard deviation `UNKNOWN_M`. Without common pixels the covariance is infinite.
        """
        half_rad = 0.5 / self.pair.reference.cameras[0].fx
        steps = np.repeat([half_rad * self.depth_m, half_rad], 3)
        aside = [se3.exp(sign * twist) @ self.T_live_reference for twist in np.diag(steps) for sign in (1.0, -1.0)]
        n, *around = normal_equations(self.pair.kernels, self.pair.level(0), [self.T_live_reference, *aside], whole=1)
        used = np.mean([other.sums[1] for other in around])
        if min(used, n.sums[1]) < MIN_PIXELS:
            return np.diag(np.full(6, np.inf))
        directions, decided = _axes(n, self.depth_m)
        basis, unknown = directions[:, decided], directions[:, ~decided]
        slope = basis.T @ _slope(around, steps) @ basis * n.sums[1] / used
        bread = basis @ np.linalg.inv(slope) @ basis.T
        return np.asarray(
            bread @ n.S @ bread.T + (UNKNOWN_M * self.pair.reference.scene_scale) ** 2 * unknown @ unknown.T
        )

    @property
    def bias(self) -> Matrix:
        """Return the standard deviation [6] of the systematic error that `covariance` does not contain, m and rad: the
        translation at the mean depth, and the rotation, that shift the image by `BIAS_PX`."""
        bias_rad = BIAS_PX / self.pair.reference.cameras[0].fx
        return np.repeat([bias_rad * self.depth_m, bias_rad], 3)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images to align, and the weight of gray relative to depth if readings are as sure as usual; gain: factor on
    the gray of the live image that makes both as bright."""

    reference: Pyramid
    live: Pyramid
    weight_color: float
    gain: float = 1.0

    @property
    def kernels(self) -> ImageKernels:
        """Return the kernels that align both images."""
        return self.reference.kernels

    def level(self, k: int) -> LevelPlanes:
        """Return one pyramid level of both images in the layout of the kernels."""
        r, live, width = self.reference, self.live, min(k, LEVELS - 1)
        c, scale, noise = r.cameras[k], r.scene_scale, live.noise_per_m / NOISE_PER_M
        weight_gray = balanced(self.weight_color, r.confidence)
        options = [weight_gray, 1.0 - weight_gray]
        options += [HUBER_GRAY[width], HUBER_DEPTH_RELATIVE[width] * noise, DEPTH_GATES_M[width] * scale, self.gain]
        return LevelPlanes(
            r.gray[k], r.depth[k], r.weight[k], r.weight_depth[k], live.gray[k], live.depth[k],
            [c.fx, c.fy, c.cx, c.cy], options, _noise_at(r.noise[k], width), r.color_depth(k),
            readouts(r.readout, live.readout),
        )  # fmt: skip


def balanced(weight_color: float, confidence: float) -> float:
    """Return the weight of gray, 0 to 1, for readings that are `confidence` times as sure as usual.

    Narrower widths alone give depth this many times as much weight, as if nothing but noise were wrong with it. The
    error of an alignment has other parts, which do not become smaller: so gray's share grows with the square root, up
    to that of depth.
    """
    if confidence == 1.0 or weight_color in (0.0, 1.0):
        return weight_color
    usual = weight_color / (1.0 - weight_color)
    odds = min(usual * math.sqrt(confidence), max(usual, 1.0))
    return odds / (1.0 + odds)


def _noise_at(noise: Plane | None, width: int) -> Plane | None:
    """Return the factor on the Huber width of depth at a level for relative noise [h, w].

    The width of a coarse level contains, besides noise, what the pose is off there. Only the part that is noise, the
    width of the finest level, is replaced. A noise of 1 gives exactly 1.
    """
    if noise is None or width == 0:
        return noise
    share = (HUBER_DEPTH_RELATIVE[0] / HUBER_DEPTH_RELATIVE[width]) ** 2
    return (1.0 + (noise * noise - 1.0) * share) ** 0.5


@dataclass(eq=False)
class Normal:
    """The normal equations of one step; values: as the kernels return them (native/align_pixel.h)."""

    values: Matrix

    @property
    def H(self) -> Matrix:
        """Return the information [6, 6] with respect to a left twist."""
        return _symmetric(self.values[:21])

    @property
    def b(self) -> Matrix:
        """Return the gradient [6]."""
        return self.values[21:27]

    @property
    def sums(self) -> Matrix:
        """Return the weighted cost, and the number of pixels used, of pixels in view that fall on a live depth reading,
        of those whose depths agree, and of pixels that both cameras see."""
        return self.values[27:32]

    @property
    def S(self) -> Matrix:
        """Return Σ b_c b_cᵀ [6, 6] over the cells c of the image."""
        return _symmetric(self.values[32:53])

    @property
    def grays(self) -> Matrix:
        """Return the sums of gray in the live image and in the reference, by the weights of the pixels."""
        return self.values[53:]

    @property
    def gain(self) -> float:
        """Return the factor on the gray of the live image that makes both as bright.

        A camera that changes its exposure multiplies the light, and with it the gray, also after gamma. Means hardly
        depend on noise, nor on a motion that is not exact yet.
        """
        live, reference = self.grays.tolist()
        return float(reference / live) if live > 0.0 else 1.0


def normal_equations(
    kernels: ImageKernels, level: LevelPlanes, motions: Sequence[Matrix], whole: int | None = None
) -> list[Normal]:
    """Linearise the residuals of a level at up to 13 motions T_live_reference; from number `whole` on, if it is given,
    by fewer rows of the image, at least 120."""
    found = kernels.normal_equations(level, motions, len(motions) if whole is None else whole)
    return [Normal(values) for values in found]


def align(
    reference: Pyramid, live: Pyramid, T_live_reference: Matrix, iterations: int = ITERATIONS,
    weight_color: float = 0.5, update_stop: float = UPDATE_STOP, plateau_stop: float = 0.0,
) -> Alignment:  # fmt: skip
    """Find the motion from the reference to the live image, starting at an initial guess.

    Each level takes at most `iterations` Gauss–Newton steps with Huber weights. H is too steep, as
    `Alignment.covariance` explains. So a step is 1 to 3 times as long as H says: by the factor by which H exceeds the
    change of the gradient along the step before. A level ends when a step is below `update_stop` (m, rad; twice as much
    on each coarser level), or when the relative change of the cost is below `plateau_stop` (0 = off). If the finest
    level meets neither condition, its best iterate is returned. Undetermined directions keep the guess. weight_color in
    [0, 1] balances gray against depth, each in units of its Huber width. Each step also finds the gain of the live
    image. With 0 iterations the guess stays, and is judged. Raises BackendError if only one image is on a device.
    """
    if reference.kernels is not live.kernels:
        raise BackendError("the two images to align are on different devices; make both for the same view")
    rules = AlignRules(iterations, update_stop, plateau_stop, DEGENERATE, MIN_PIXELS)
    pair = Pair(reference, live, weight_color)
    levels = [pair.level(k) for k in range(len(reference.cameras))]
    found = pair.kernels.align(levels, reference.readings, T_live_reference, rules)
    sums, gain = found.sums, found.gain
    if not iterations:
        still = normal_equations(pair.kernels, levels[0], [T_live_reference])[0]
        sums, gain = still.sums, still.gain
    return Alignment(
        se3.orthonormalise(found.T), agreement=float(sums[3] / max(sums[2], 1.0)),
        overlap=float(sums[4] / max(found.readings, 1.0)), degenerate=found.degenerate,
        cost=float(sums[0] / max(sums[1], 1.0)), steps=found.steps, pair=replace(pair, gain=gain),
        depth_m=found.depth_m,
    )  # fmt: skip


def gray_share(reference: Pyramid, live: Pyramid, T_live_reference: Matrix) -> float:
    """Return the weight of gray, 0 to 1, that is due to it by how well gray and depth agree at a guess [4, 4].

    Each is weighted by the inverse of its size: the root of its mean cost at the finest size, where its Huber width is
    the unit. The inverse of the variance would be right if residuals were nothing but noise. Errors of other kinds do
    not become smaller with it, as in `balanced`. Some 120 rows are enough.
    """

    def at(weight: float, gain: float = 1.0) -> Normal:
        level = Pair(reference, live, weight, gain).level(0)
        return normal_equations(reference.kernels, level, [T_live_reference], whole=0)[0]

    gain = at(1.0).gain
    gray, depth = (math.sqrt(n.sums[0] / max(n.sums[1], 1.0)) for n in (at(1.0, gain), at(0.0, gain)))
    return depth / max(gray + depth, 1e-9)


def _axes(n: Normal, depth_m: float) -> tuple[Matrix, NDArray[np.bool_]]:
    """Split the information into principal directions; rotations count by the shift they cause at the mean depth.

    Returns the directions as columns [6, 6], and which of them the images determine [6] (Zhang et al. 2016).
    """
    unit = np.repeat([1.0, 1.0 / depth_m], 3)
    eigenvalues, directions = np.linalg.eigh(n.H * np.outer(unit, unit))
    return directions * unit[:, None], eigenvalues > DEGENERATE * max(eigenvalues[-1], 1e-300)


def _slope(around: Sequence[Normal], steps: Matrix) -> Matrix:
    """Return the derivative of the gradient by the twist, made symmetric: central differences with steps [6]."""
    pulls = np.stack([n.b for n in around])
    D = ((pulls[::2] - pulls[1::2]) / (2.0 * steps[:, None])).T
    return np.asarray(0.5 * (D + D.T))


def _symmetric(upper: Matrix) -> Matrix:
    full = np.zeros((6, 6))
    full[UPPER] = upper
    return full + np.triu(full, 1).T
