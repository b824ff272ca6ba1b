"""Fit the pose of one camera to a fixed field: by the papers' Adam through the renderer, or by image alignment. Fit its
exposure in closed form.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import NEUTRAL
from sigmasplat.fit.align import ITERATIONS, Alignment, align
from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.compare import Comparison, best_alignment, compare
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.fit.target import NEARLY_BLACK, Target
from sigmasplat.fit.tracking_loss import PoseMaps, agreement
from sigmasplat.render.view import View
from sigmasplat.types import Matrix


@dataclass(eq=False)
class PoseFit:
    """The result of a pose fit: T_camera_world and its quality.

    agreement: share of the pixels visible to both map and sensor whose depths agree; overlap: share of sensor readings
    where the map has a surface; first and last loss; iterations; alignment: the alignment that found the pose, or None;
    exposure (a, b) of exp(a)·Ĉ + b; comparison: of the two images at the pose, if it was made.
    """

    T_camera_world: Matrix
    agreement: float
    overlap: float
    first_loss: float
    loss: float
    iterations: int
    alignment: Alignment | None = None
    exposure: tuple[float, float] = (0.0, 0.0)
    comparison: Comparison | None = None

    @property
    def covariance(self) -> Matrix | None:
        """Return the covariance [6, 6] of the left twist (ρ, φ), m and rad, relative to the reference; None after
        descent."""
        return None if self.alignment is None else self.alignment.covariance


def fit_pose_adam(
    params: Tensor, view: View, target: Target, T_camera_world: Matrix, config: TrackingConfig, iterations: int
) -> PoseFit:
    """Minimise L_track by Adam (`fit.descent`) and return the best iterate. On CUDA the loop runs without the host.

    params [N, 17] and σ² are fixed (VarSplat §3). The descent stops early when
    `plateau_window` steps have not lowered the loss by the share `plateau_stop`. Without common pixels the guess is
    returned. Raises BackendError if a CUDA device has too many pairs of splats and tiles.
    """
    params, target = params.to(view.sums.device), target.to(view.sums.device)
    found = fits_of(view).descend(params, view, target, T_camera_world, config, iterations)
    view.forward(params, found.T_camera_world)
    agree, overlap = agreement(PoseMaps.of(view), target)
    T_best = se3.orthonormalise(found.T_camera_world)
    return PoseFit(T_best, agree, overlap, found.first_loss, found.loss, found.steps, exposure=found.exposure)


def fit_pose_align(
    reference: Reference, live: Pyramid, T_camera_world: Matrix, config: TrackingConfig, moves: bool = True
) -> PoseFit:
    """Align the live image, a gray and depth (m) pyramid, to a reference by Gauss–Newton (`fit.align`), from a guess.

    T_camera_world [4, 4]: the guess for the live camera; moves: if False, it is only judged. With `config.verify` the
    finest size alone is a second candidate, and the result has the comparison with the reference. Its `loss` is the
    final cost and `first_loss` is NaN.
    """
    guess = T_camera_world @ se3.inverse(reference.T_camera_world)
    seen: Comparison | None = None
    if config.verify and moves:
        found, seen = best_alignment(reference.pyramid, live, guess, config.align_weight_color)
    else:
        found = align(
            reference.pyramid, live, guess, ITERATIONS * moves, config.align_weight_color,
            plateau_stop=config.plateau_stop,
        )  # fmt: skip
        if config.verify:
            seen = compare(reference.pyramid, live, found.T_live_reference)
    return PoseFit(
        found.T_live_reference @ reference.T_camera_world, found.agreement, found.overlap, float("nan"), found.cost,
        found.steps, alignment=found, comparison=seen,
    )  # fmt: skip


EVERY = 47
"""Every 47th pixel is used: 1600 pixels of a 320×240 image determine two numbers per channel well."""
OPAQUE, BRIGHTEST = 0.9, 0.98
"""Pixels are used if the map covers them, and no channel of the recorded colour is nearly black or saturated."""
OUTLIER = 0.03
"""Residuals above this count less: weight 1 / (|r| + OUTLIER), the L1 norm for large ones."""
PRIOR = np.diag([0.002, 0.01])
"""Information of the prior (neutral exposure) per pixel. It decides for images with hardly any contrast."""


def fit_exposure(view: View, target: Target) -> Matrix:
    """Return the exposure [3, 2] with which a view's rendered colours are nearest to those of an image, by one step of
    iteratively reweighted least squares; neutral if no pixel can be compared."""
    rendered, recorded = (_sampled(plane) for plane in (view.sums[:3], target.color))
    known = (_sampled(view.alpha[None])[0] > OPAQUE) & (recorded.min(0) > NEARLY_BLACK) & (recorded.max(0) < BRIGHTEST)
    if not known.any():
        return NEUTRAL.copy()
    r, c = rendered[:, known], recorded[:, known]
    w = 1.0 / (np.abs(c - r) + OUTLIER)
    w /= w.sum(1, keepdims=True)
    rr, r1, rc, c1 = ((w * product).sum(1) for product in (r * r, r, r * c, c))
    information = np.moveaxis(np.array([[rr, r1], [r1, np.ones(3)]]), -1, 0) + PRIOR
    return np.linalg.solve(information, (np.stack([rc, c1], -1) + PRIOR @ NEUTRAL[0])[..., None])[..., 0]


def _sampled(planes: Tensor) -> NDArray[np.float64]:
    """Return every `EVERY`-th pixel of planes [C, rows, columns] as [C, P]."""
    return np.asarray(planes.reshape(len(planes), -1)[:, ::EVERY].cpu(), np.float64)
