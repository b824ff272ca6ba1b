"""Combine the log and the path of a run: the state of each frame at the end of the run, and its pose if valid."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.readout import Readout, SensorTimes
from sigmasplat.data.trajectory import LOST, TRACKED, Trajectory, outside_world, states_at_end, submaps_outside
from sigmasplat.input.imu import up_of_path

Log = list[dict[str, Any]]

SAME_TIME_S = 1e-4
"""Log and trajectory hold the same timestamps up to rounding."""


@dataclass(frozen=True, eq=False)
class RunFrames:
    """The frames of a run in the order of its log.

    log [F]: the records of log.jsonl; states [F]: the states at the end of the run; rows [B]: the rows of the valid
    frames (tracked or relocalised, and connected to the world), in ascending order; path: their poses.

    A component can join the world after its frames were logged, so a state can differ from the one in the log: a frame
    that is not lost is apart if trajectory.txt does not contain it.
    """

    log: Log
    states: tuple[str, ...]
    rows: NDArray[np.intp]
    path: Trajectory

    @staticmethod
    def of(log: Log, trajectory: Trajectory) -> "RunFrames":
        """Combine a log and the poses of trajectory.txt."""
        rows, poses = _common(log, trajectory.timestamps_s)
        logged = [LOST if record.get("lost") else record.get("state", TRACKED) for record in log]
        states = states_at_end(logged, np.isin(np.arange(len(log)), rows))
        return RunFrames(log, tuple(states.tolist()), rows, trajectory.at(poses))

    def __len__(self) -> int:
        return len(self.log)

    def indices(self, state: str) -> list[int]:
        """Return the numbers, in the source, of the frames with a state."""
        return [record["index"] for record, found in zip(self.log, self.states, strict=True) if found == state]

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Return whether the pose of each frame is valid [F]."""
        return np.isin(np.arange(len(self)), self.rows)

    @cached_property
    def p_off(self) -> NDArray[np.float64]:
        """Return the logged probability [F] that each pose is off by more than 5 cm; nan if it is not known."""
        return np.array([np.nan if r.get("p_off") is None else r["p_off"] for r in self.log], np.float64)

    def measured_up(self) -> NDArray[np.float64] | None:
        """Return the unit vector [3] that points up in the world, from the forces that an accelerometer measured on the
        valid frames; None if it did not."""
        forces = [self.log[row].get("specific_force_m_s2") for row in self.rows]
        known = [i for i, force in enumerate(forces) if force is not None]
        return up_of_path(self.path.T_world_camera[known], np.array([forces[i] for i in known]).reshape(-1, 3))

    def posed_log(self) -> Log:
        """Return the records of the valid frames, each with `T_world_camera` [4, 4], its `state` at the end, and
        its `row` in the log."""
        return [
            self.log[row] | {"T_world_camera": T, "row": int(row), "state": self.states[row]}
            for row, T in zip(self.rows, self.path.T_world_camera, strict=True)
        ]

    def readouts(self, facts: Mapping[str, Any]) -> dict[int, Readout]:
        """Return when the rows of the valid frames were read, by their numbers in the source, as far as the run has
        measured it (facts: run.json); the camera moves between the frames before and after."""
        times, every = SensorTimes.noted_in(facts), np.arange(len(self.path))
        if times.std_s is None or len(every) < 2:
            return {}
        rates = se3.rates(self.path.T_world_camera, self.path.timestamps_s, every, every >= 0)
        return {self.log[row]["index"]: Readout(rate, 0.0, times) for row, rate in zip(self.rows, rates, strict=True)}

    def outside(self) -> NDArray[np.bool_]:
        """Return whether each frame [F] is outside the world: apart, or lost after a frame that is apart."""
        return outside_world(np.array(self.states))

    def submaps_outside(self) -> frozenset[int]:
        """Return the submaps that are not connected to the world."""
        return submaps_outside(np.array(self.states), np.array([r.get("submap", 0) for r in self.log], np.int64))


def noted_up(facts: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """Return the unit vector [3] that points up in a run's world from its facts (run.json), None if an accelerometer
    did not measure it."""
    up = facts.get("up_world")
    return None if up is None else np.array(up) / np.linalg.norm(up)


def _common(log: Log, times_s: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows of the log that have a pose, and the rows of their poses.

    The trajectory has the order of the log, so that frames with equal timestamps are told apart by their order.
    """
    pairs, pose = list[tuple[int, int]](), 0
    for row, record in enumerate(log):
        if pose == len(times_s):
            break
        if record.get("lost"):
            continue
        if abs(record["timestamp_s"] - times_s[pose]) <= SAME_TIME_S:
            pairs.append((row, pose))
            pose += 1
    rows, poses = np.array(pairs, np.intp).reshape(-1, 2).T
    return rows, poses
