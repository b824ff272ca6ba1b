"""Compare two RGB-D images at a given motion: does the depth of one lie on the surface of the other?

Alignment minimises residuals, so its own cost cannot tell a wrong minimum from a right one. This comparison is made
afterwards, with the noise of the sensor as its unit. It also separates the two signs of a depth difference: an object
in front may be new, but seeing through a known surface contradicts the pose.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.readout import readouts
from sigmasplat.fit.align import Alignment, Pair, align, gray_share, normal_equations
from sigmasplat.fit.pyramid import HIDDEN_M, NOISE_PER_M, Pyramid
from sigmasplat.native import _core
from sigmasplat.types import Matrix

STEP = 4
"""Every fourth row and column of the finest size is compared: coarser ones have no depth where the sensor is noisy."""
NOISE_M = 0.002
"""Standard deviation of a depth reading at a distance of 0; a share of z² is added (`Pyramid.noise_per_m`)."""
CLOSE_SIGMA, CLOSE_M = 3.0, 0.02
"""Two surfaces are the same if they are closer than this many standard deviations plus a tolerance for the pose."""
LEAST_PIXELS = 50
FLAT = 0.01
"""A gray image with a smaller standard deviation (0 to 1) has no texture to compare."""
SLIDE, COARSE = 0.05, 2
"""How strongly images hold a pose is measured by a motion of this share of the depth, at this level of the pyramids."""
UNDECIDED = 1e-3
"""The finest size alone replaces coarse to fine only if it agrees better by more than this."""


@dataclass(frozen=True)
class Comparison:
    """How well two images agree at a motion.

    common: share of the reference's readings that fall on a live reading; close, front, behind: shares of these whose
    live surface is the same, nearer, or farther. Of those that are not in front: residual, the median |depth
    difference| in standard deviations of a reading; correlation of the gray values, −1 to 1, NaN if one image is flat.
    points: the number of compared pixels; covered: their number relative to that of the live readings, at most 1.
    moved: how far the alignment has moved the image from its guess, as a share of the depth; 0 without one. held: how
    strongly the images hold the pose (`held`); without an alignment, the usual value.
    """

    common: float
    close: float
    front: float
    behind: float
    residual: float
    correlation: float
    points: int = 0
    covered: float = 1.0
    moved: float = 0.0
    held: float = 0.3


NOTHING = Comparison(0.0, 0.0, 0.0, 0.0, float("inf"), float("nan"))


def compare(reference: Pyramid, live: Pyramid, T_live_reference: Matrix) -> Comparison:
    """Compare two images at T_live_reference [4, 4]; `NOTHING` if they have less than 50 compared pixels in common.

    Points of the reference that fall on live pixels of depth `HIDDEN_M` are left out.
    """
    host, c, found = reference.kernels.to_host, reference.cameras[0], np.empty(8)
    depth, gray = host(reference.depth[0]), host(reference.gray[0])
    T, color_depth = np.ascontiguousarray(T_live_reference, np.float64), reference.color_depth(0)
    if not _core.compare(
        depth, gray, host(live.depth[0]), host(live.gray[0]), [c.fx, c.fy, c.cx, c.cy], T,
        _rules(HIDDEN_M, live.noise_per_m, live.scene_scale), found,
        None if color_depth is None else host(color_depth), readouts(reference.readout, live.readout),
    ):  # fmt: skip
        return NOTHING
    common, close, front, behind, residual, correlation, points, covered = found.tolist()
    return Comparison(common, close, front, behind, residual, correlation, int(points), covered)


def best_alignment(
    reference: Pyramid, live: Pyramid, T_live_reference: Matrix, weight_color: float | None = None, near: bool = False
) -> tuple[Alignment, Comparison]:
    """Align two images coarse to fine, and at the finest size alone; return what agrees better at full resolution.

    Coarse sizes reach far, but where the scene repeats they pull the pose away, and fine sizes cannot come back.
    weight_color: as of `align`; None: measured (`gray_share`). near: the guess needs no coarse sizes.
    """
    weight = gray_share(reference, live, T_live_reference) if weight_color is None else weight_color
    pairs = [(reference.finest(), live.finest())] if near else [(reference, live), (reference.finest(), live.finest())]
    found = [align(*pair, T_live_reference, weight_color=weight) for pair in pairs]
    seen = [compare(reference, live, motion.T_live_reference) for motion in found]
    best = int(not near and agreement(seen[1]) > agreement(seen[0]) + UNDECIDED)
    T = found[best].T_live_reference @ se3.inverse(T_live_reference)
    moved = math.hypot(float(np.linalg.norm(T[:3, 3])) / found[best].depth_m, se3.rotation_angle(T[:3, :3]))
    return found[best], replace(seen[best], moved=moved, held=held(reference, live, found[best]))


def held(reference: Pyramid, live: Pyramid, found: Alignment, weight_color: float = 0.5) -> float:
    """Return how strongly two images hold their motion: by how many Huber widths residuals change (root mean square) if
    it changes by `SLIDE` of the depth in the direction that changes them least.

    Along a bare wall depth hardly changes. A coarse size is used: at the finest, the noise of gradients pretends to
    hold any pose. weight_color: as of `align`.
    """
    level = Pair(reference, live, weight_color, found.pair.gain).level(min(COARSE, len(reference.cameras) - 1))
    n = normal_equations(reference.kernels, level, [found.T_live_reference])[0]
    unit = np.repeat([found.depth_m, 1.0], 3)
    least = np.linalg.eigvalsh(n.H * np.outer(unit, unit))[0]
    return SLIDE * float(np.sqrt(max(least, 0.0) / max(n.sums[1], 1.0)))


def agreement(seen: Comparison) -> float:
    """Return how well two images agree: the share of close depths times the correlation of gray values, if known."""
    return seen.close if np.isnan(seen.correlation) else seen.close * seen.correlation


def noise_scale(depth: NDArray[np.float32], noise_per_m: float = NOISE_PER_M, scene_scale: float = 1.0) -> float:
    """Return the factor, at least 1, by which a depth image [h, w] is noisier than assumed.

    It is measured by the difference of each reading from the mean of its two neighbours in the row. Without noise, this
    difference is nearly 0 on smooth surfaces.
    """
    return _core.noise_scale(np.ascontiguousarray(depth), _rules(float("inf"), noise_per_m, scene_scale))


def _rules(hidden_m: float, noise_per_m: float, scene_scale: float) -> list[float]:
    """Return the constants of a comparison in the order of the kernels; readings from hidden_m on are left out."""
    metres = NOISE_M * scene_scale, CLOSE_M * scene_scale
    return [STEP, LEAST_PIXELS, noise_per_m, metres[0], CLOSE_SIGMA, metres[1], FLAT, hidden_m]
