"""Where the camera is expected before its image is used, and its motion since the last image."""

from dataclasses import dataclass, field

import numpy as np
from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.frame import PosePrior
from sigmasplat.fit.align import ITERATIONS, align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.render.view import View
from sigmasplat.types import Matrix, ShouldStop


@dataclass(frozen=True, eq=False)
class PosePrediction:
    """Expected motion and pose of the camera, known before its image is used.

    motion: T_previous_camera with constant velocity; turn: T_previous_camera without translation; predicted:
    T_world_camera, the first guess; last: T_world_camera, the last pose. If a gyroscope measured the rotation since the
    last frame (`measured`), this rotation is part of all four. given: whether `predicted` is the pose itself, because
    the motion since the last frame is given.
    """

    motion: Matrix
    turn: Matrix
    predicted: Matrix
    last: Matrix
    measured: bool
    given: bool = False


LONGEST_S = 1.0
"""The camera is not expected to move on for longer: a hand has turned back by then."""


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """The motion of the camera at the time of a frame, s: T_last_camera [4, 4], and the time since the last frame, s;
    at rest if they are not known."""

    time_s: float = 0.0
    velocity: Matrix = field(default_factory=lambda: np.eye(4))
    elapsed_s: float = 0.0

    def after(self, T_last_camera: Matrix, time_s: float) -> "CameraMotion":
        """Return the motion at the next frame."""
        return CameraMotion(time_s, T_last_camera, max(time_s - self.time_s, 0.0))

    def until(self, time_s: float) -> Matrix:
        """Return the motion T_last_camera [4, 4] to a time at constant velocity; the last one if frames are evenly
        timed."""
        elapsed_s = min(max(time_s - self.time_s, 0.0), max(LONGEST_S, self.elapsed_s))
        share = elapsed_s / self.elapsed_s if self.elapsed_s else 1.0
        return self.velocity if abs(share - 1.0) < 1e-3 else se3.exp(share * se3.log(self.velocity))

    def stopped(self) -> "CameraMotion":
        """Return no motion: poses of earlier frames do not agree with later ones."""
        return CameraMotion(self.time_s)

    def rate(self, next_: "CameraMotion | None" = None) -> Matrix:
        """Return the motion at this frame, a twist per second [6] in its axes: the mean since the frame before, or, if
        the motion at the next frame is known, from the frame before to the next one. This central difference neither
        lags behind the motion nor doubles the noise of poses."""
        motions = [self] if next_ is None else [self, next_]
        elapsed_s = sum(motion.elapsed_s for motion in motions)
        moved = np.sum([se3.log(motion.velocity) for motion in motions], 0)
        return np.asarray(moved / elapsed_s if elapsed_s > 0.0 else np.zeros(6))


def predict(previous: Matrix, velocity: Matrix, before: PosePrior, now: PosePrior) -> PosePrediction:
    """Predict the pose by constant velocity; with a gyroscope, its rotation replaces that of the velocity; given poses
    replace the whole motion.

    previous, velocity [4, 4]: the last pose T_world_camera and motion; before, now: of the last frame and of this one.
    """
    if before.T_given_camera is not None and now.T_given_camera is not None:
        motion = se3.inverse(before.T_given_camera) @ now.T_given_camera
        return PosePrediction(motion, np.eye(4), previous @ motion, previous, measured=False, given=True)
    R_before, R_now = before.R_inertial_camera, now.R_inertial_camera
    motion, turn, last, measured = velocity, np.eye(4), previous, False
    if R_before is not None and R_now is not None:
        motion, measured = motion.copy(), True
        motion[:3, :3] = turn[:3, :3] = R_before.T @ R_now
        last = last @ turn
    return PosePrediction(motion, turn, previous @ motion, last, measured)


@dataclass(frozen=True, eq=False)
class Given:
    """What all fits of one frame share: the rows of the map [N, 17], its view, where the camera is expected, and
    whether to stop."""

    params: Tensor
    view: View
    prediction: PosePrediction
    should_stop: ShouldStop


def odometry(last: Pyramid | None, live: Pyramid, given: Given, config: TrackingConfig) -> Matrix | None:
    """Align the last image to this one and return T_live_last [4, 4]; None without a last image, or if it fails."""
    if last is None:
        return None
    prediction = given.prediction
    guesses = (se3.inverse(prediction.motion), prediction.turn.T.copy())  # the inverse, because it has no translation
    found = [align(last, live, g, 2 * ITERATIONS, config.align_weight_color) for g in guesses]
    best = max(found, key=lambda a: a.agreement * a.overlap)
    return None if best.agreement * best.overlap < config.lost_share else best.T_live_reference
