"""Where the camera is expected before its image is used, and its motion since the last image."""

from dataclasses import dataclass

from sigmasplat.config import TrackingConfig
from sigmasplat.fit.align import align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.model import se3
from sigmasplat.types import Matrix


@dataclass(frozen=True, eq=False)
class Expected:
    """Expected motion and pose of the camera, known before its image is used.

    motion: T_previous_camera with constant velocity; turn: T_previous_camera without translation; predicted:
    T_world_camera, the first guess; last: T_world_camera, the last pose. If a gyroscope measured the rotation since the
    last frame (`measured`), this rotation is part of all four.
    """

    motion: Matrix
    turn: Matrix
    predicted: Matrix
    last: Matrix
    measured: bool


def odometry(last: Pyramid, live: Pyramid, expected: Expected, config: TrackingConfig) -> Matrix | None:
    """Align the last image to this one and return T_live_last [4, 4]; None if it fails."""
    guesses = (se3.inverse(expected.motion), expected.turn.T.copy())  # the inverse, because it has no translation
    found = [align(last, live, g, 2 * config.align_iterations, config.align_weight_color) for g in guesses]
    best = max(found, key=lambda a: a.agreement * a.overlap)
    return None if best.agreement * best.overlap < config.lost_share else best.T_live_reference
