"""A trajectory: camera poses over time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import SourceError
from sigmasplat.model import se3


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses over time: timestamps_s float64 [N], T_world_camera float64 [N, 4, 4] (camera to world, metres).

    Raises SourceError if a pose is not finite or not rigid.
    """

    timestamps_s: NDArray[np.float64]
    T_world_camera: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.T_world_camera.shape != (len(self.timestamps_s), 4, 4):
            raise SourceError(
                f"trajectory has {len(self.timestamps_s)} timestamps but poses of shape {self.T_world_camera.shape}"
            )
        for t, T in zip(self.timestamps_s, self.T_world_camera, strict=True):
            if not (np.isfinite(t) and se3.is_rigid(T)):
                raise SourceError(
                    f"pose at t={t} s is not a finite rigid transform; remove it or correct its rotation "
                    f"(found {T.tolist()})"
                )

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def at(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> "Trajectory":
        """Return the poses at some rows, given by their numbers or as a mask [N]."""
        return Trajectory(self.timestamps_s[rows], self.T_world_camera[rows])
