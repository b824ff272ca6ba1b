"""States of frames, and the parts of an atlas that are not connected to its first frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.field import GaussianField
from sigmasplat.data.trajectory import Trajectory

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
