"""Tracking: predict the pose, fit it to the fixed map, check the fit, and retry from other poses if it is doubtful."""

import dataclasses
from dataclasses import dataclass, field as dataclass_field

import numpy as np

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.align import align
from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.pose import PoseFit, fit_pose_adam, fit_pose_align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference, keyframe_reference, map_reference
from sigmasplat.fit.target import Target
from sigmasplat.model import se3
from sigmasplat.model.field import GaussianField
from sigmasplat.render.view import View
from sigmasplat.slam.rules import is_lost, jumped
from sigmasplat.types import Matrix

DOUBT = 0.7
"""A pose is doubtful if its agreement × overlap falls below this share of the usual value."""


@dataclass(eq=False)
class Tracker:
    """Keeps the last pose, the velocity, the last image, the reference keyframe, and statistics of recent fits."""

    config: TrackingConfig
    previous: Matrix = dataclass_field(default_factory=lambda: np.eye(4))
    velocity: Matrix = dataclass_field(default_factory=lambda: np.eye(4))
    last_image: Pyramid | None = None
    keyframe: Reference | None = None
    agreements: list[float] = dataclass_field(default_factory=list)
    first_losses: list[float] = dataclass_field(default_factory=list)
    lost: bool = False
    started: bool = False
    """Whether a frame has been tracked yet."""

    def start(self, live: Pyramid) -> None:
        """Fix the gauge: the first camera is the world."""
        self.last_image = live

    def track(self, field: GaussianField, view: View, target: Target, live: Pyramid) -> PoseFit:
        """Estimate T_camera_world of a frame; `self.lost` then says whether tracking failed.

        A lost frame gets the best available guess (odometry, else the last pose), and the velocity is reset.
        """
        predicted = self.previous @ self.velocity if self.config.motion_model else self.previous
        fit = self._fit(field, view, target, live, predicted)
        if self._doubtful(fit):
            fit = self._retry(field, view, target, live, fit)
        self.lost = is_lost(fit, self.config.lost_agreement, self.config.lost_share)
        fit.T_camera_world = se3.orthonormalise(fit.T_camera_world)
        T_world_camera = se3.inverse(fit.T_camera_world)
        if self.lost:
            self.velocity = np.eye(4)
        else:
            self.velocity = se3.inverse(self.previous) @ T_world_camera
            self.agreements.append(fit.agreement * fit.overlap)
            self.first_losses.append(fit.first_loss)
        self.previous = T_world_camera
        self.last_image, self.started = live, True
        return fit

    def _fit(
        self, field: GaussianField, view: View, target: Target, live: Pyramid, guess: Matrix, patience: int = 1
    ) -> PoseFit:
        """Fit from an initial T_world_camera; patience: factor on the number of iterations of gradient descent."""
        T_camera_world = se3.inverse(guess)
        if self.config.method == "adam":
            config = self.config if self.started else _without_motion(self.config)
            return fit_pose_adam(field.params, view, target, T_camera_world, config, patience * config.iterations)
        if self.config.align_to == "keyframe" and self.keyframe is not None:
            return fit_pose_align(self.keyframe, live, T_camera_world, self.config)
        reference = map_reference(field.params, view, T_camera_world, self.config)
        return fit_pose_align(reference, live, T_camera_world, self.config)

    def _doubtful(self, fit: PoseFit) -> bool:
        usual = float(np.median(self.agreements[-50:])) if self.agreements else 1.0
        worse = fit.agreement * fit.overlap < DOUBT * usual
        return worse or jumped(fit.first_loss, self.first_losses, self.config.reinit_factor)

    def _retry(self, field: GaussianField, view: View, target: Target, live: Pyramid, fit: PoseFit) -> PoseFit:
        """Retry from odometry with twice the iterations (VarSplat §3), and from the last pose; return the best fit.

        With alignment, also try the map rendered at these poses: it contains more than the newest keyframe.
        """
        odometry = self._odometry(view, live)
        starts = [self.previous] if odometry is None else [odometry, self.previous]
        fits = [fit] + [self._fit(field, view, target, live, s, 2) for s in starts]
        if self.config.method == "align" and self.config.align_to == "keyframe":  # with "map", `_fit` has tried it
            for start in starts:
                reference = map_reference(field.params, view, se3.inverse(start), self.config)
                fits.append(fit_pose_align(reference, live, se3.inverse(start), self.config))
        best = max(fits, key=lambda f: f.agreement * f.overlap)
        if is_lost(best, self.config.lost_agreement, self.config.lost_share):
            best.T_camera_world = se3.inverse(starts[0])
        return best

    def _odometry(self, view: View, live: Pyramid) -> Matrix | None:
        """Align the last image to this one and return T_world_camera; None if this fails too."""
        if self.last_image is None or (self.config.method == "adam" and not fits_of(view).aligns):
            return None  # alignment needs the compiled kernels
        guesses = (se3.inverse(self.velocity), np.eye(4))
        found = [
            align(self.last_image, live, g, 2 * self.config.align_iterations, self.config.align_weight_color)
            for g in guesses
        ]
        best = max(found, key=lambda a: a.agreement * a.overlap)
        if best.agreement * best.overlap < self.config.lost_share:
            return None
        return np.asarray(self.previous @ se3.inverse(best.T_live_reference))

    def keep_keyframe(self, field: GaussianField, view: View, live: Pyramid, T_world_camera: Matrix) -> None:
        """Use a keyframe that was just mapped: its refined pose, and its image as the reference of the next frames."""
        self.previous = T_world_camera
        if self.config.method == "align" or fits_of(view).aligns:  # otherwise nothing aligns to it
            self.keyframe = keyframe_reference(field.params, view, live, se3.inverse(T_world_camera), self.config)

    def hop_covariance(self, fit: PoseFit, live: Pyramid) -> Matrix | None:
        """Estimate the covariance [6, 6] of a fit's left twist to the newest keyframe; None without the kernels.

        For a pose found by gradient descent, the covariance is that of an alignment to the keyframe's image.
        """
        if fit.alignment is not None or self.keyframe is None:
            return fit.covariance
        T_live_keyframe = fit.T_camera_world @ se3.inverse(self.keyframe.T_camera_world)
        return align(self.keyframe.pyramid, live, T_live_keyframe, 0, self.config.align_weight_color).covariance


def _without_motion(config: TrackingConfig) -> TrackingConfig:
    """Return the settings for the second frame of a sequence, which has no motion model yet (CG-SLAM's code)."""
    return dataclasses.replace(
        config,
        iterations=config.first_iterations or config.iterations,
        lr_rotation=config.first_lr_rotation or config.lr_rotation,
    )
