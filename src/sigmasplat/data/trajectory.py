"""The path of a run: its poses, the states of frames, components, and frames evenly spread over it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.errors import SourceError

Item = TypeVar("Item")


def evenly_spaced(count: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` evenly spaced rows of `count`, including the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(np.int64))


def evenly_spread(items: Sequence[Item], most: int) -> list[Item]:
    """Return at most `most` items, evenly spread, with the first and the last one."""
    return [items[row] for row in evenly_spaced(len(items), most)]


MOST_M = 1e9
"""Larger coordinates are a mistake, and their squares may overflow; geocentric ones are below 1e7 m."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses over time: timestamps_s float64 [N], T_world_camera float64 [N, 4, 4] (camera to world, metres).

    error_rms: of a true path, the root mean square lengths of the errors of a position, m, and of a rotation, rad;
    errors of two poses are independent. 0 = exact, None = unknown.
    Raises SourceError if a pose is not finite or not rigid, or farther than `MOST_M` from the origin.
    """

    timestamps_s: NDArray[np.float64]
    T_world_camera: NDArray[np.float64]
    error_rms: tuple[float, float] | None = None

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


TRACKED, RELOCALISED, LOST, APART = STATES = ("tracked", "relocalised", "lost", "apart")
"""The states of a frame. Apart: tracked in a component that is not connected to the world."""


@dataclass(frozen=True, eq=False)
class Component:
    """A component of the atlas that is not connected to the world, so its pose in the world is unknown.

    number: 1 or more; the world is component 0. Its own frame is its first camera: there are its splats (`field`) and
    the poses of its tracked frames (`trajectory`).
    """

    number: int
    field: GaussianField
    trajectory: Trajectory


def states_at_end(states: Sequence[str], valid: NDArray[np.bool_]) -> NDArray[np.str_]:
    """Return the states [F] at the end: a frame that is not lost is apart exactly if its pose is not valid.

    states [F]: as of each step, when a component may not have joined the world yet; valid [F]: at the end.
    """
    at_step = np.array(states, dtype="<U11")
    found = np.where(valid, np.where(at_step == RELOCALISED, RELOCALISED, TRACKED), APART)
    return np.where(at_step == LOST, LOST, found)


def outside_world(states: NDArray[np.str_]) -> NDArray[np.bool_]:
    """Return whether each frame [F] is apart, or lost after a frame that is apart."""
    last_found = np.maximum.accumulate(np.where(states == LOST, 0, np.arange(len(states))))
    return np.asarray(states[last_found] == APART)


def submaps_outside(states: NDArray[np.str_], submaps: NDArray[np.int64]) -> frozenset[int]:
    """Return the submaps that have a frame that is apart; states [F], submaps [F]: of all frames."""
    return frozenset(submaps[states == APART].tolist())
