"""A trajectory: camera poses over time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.errors import SourceError

MOST_M = 1e9
"""Larger coordinates are a mistake, and their squares may overflow; geocentric ones are below 1e7 m."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses over time: timestamps_s float64 [N], T_world_camera float64 [N, 4, 4] (camera to world, metres).

    Raises SourceError if a pose is not finite or not rigid, or farther than `MOST_M` from the origin.
    """

    timestamps_s: NDArray[np.float64]
    T_world_camera: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.T_world_camera.shape != (len(self.timestamps_s), 4, 4):
            raise SourceError(
                f"trajectory has {len(self.timestamps_s)} timestamps but poses of shape {self.T_world_camera.shape}"
            )
        far = np.abs(self.T_world_camera[:, :3, 3]).max(1, initial=0.0) > MOST_M
        valid = np.isfinite(self.timestamps_s) & se3.are_rigid(self.T_world_camera) & ~far
        for row in np.flatnonzero(~valid)[:1]:
            t, T = self.timestamps_s[row], self.T_world_camera[row]
            kind = f"farther than {MOST_M:g} m from the origin" if far[row] else "not a finite rigid transform"
            raise SourceError(f"pose at t={t} s is {kind}; remove it or correct it (found {T.tolist()})")

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def at(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> "Trajectory":
        """Return the poses at some rows, given by their numbers or as a mask [N]."""
        return Trajectory(self.timestamps_s[rows], self.T_world_camera[rows])
