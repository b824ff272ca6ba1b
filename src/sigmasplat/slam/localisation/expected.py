"""Where the camera is expected before its image is used."""

from dataclasses import dataclass

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
