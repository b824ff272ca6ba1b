"""The results of all frames: the newest ones whole, of earlier ones what is read later."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.column import Column, Records
from sigmasplat.data.component import APART, LOST, RELOCALISED, TRACKED
from sigmasplat.slam.step_result import Step

WHOLE_STEPS = 1000
"""Number of newest steps that are kept whole."""
STATES = (TRACKED, RELOCALISED, LOST, APART)
NUMBERS = 9
"""Columns before the pose, see `Steps.rows`."""


@dataclass(eq=False)
class Steps(Records[Step]):
    """The steps of all frames. Only the newest `WHOLE_STEPS` are kept whole; of earlier ones the values of tracking,
    loops, seconds and the covariance are dropped: they take most of the memory, and nothing reads them later.

    rows [F, 25]: of every frame index, timestamp_s, is_keyframe, lost, splats, submap, number of the state in `STATES`,
    component, p_off, and T_world_camera [4, 4] by rows; whole: the newest steps by number.
    """

    POSE_COLUMNS: ClassVar[slice] = slice(NUMBERS, NUMBERS + 16)
    """The columns of `rows` that hold a pose."""

    rows: Column = field(default_factory=lambda: Column.of(np.float64, NUMBERS + 16))
    whole: dict[int, Step] = field(default_factory=dict)

    def append(self, step: Step) -> None:
        """Append the result of the next frame."""
        number = len(self)
        self.whole[number] = step
        self.whole.pop(number - WHOLE_STEPS, None)
        numbers = (
            step.index, step.timestamp_s, step.is_keyframe, step.lost, step.splats, step.submap,
            STATES.index(step.state), step.component, step.p_off,
        )  # fmt: skip
        self.rows.append([*numbers, *step.T_world_camera.ravel()])

    @property
    def timestamps_s(self) -> NDArray[np.float64]:
        """Return the time of each frame [F]."""
        return self.rows.used[:, 1].copy()

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Return whether each frame was lost [F]."""
        return np.asarray(self.rows.used[:, 3] != 0)

    @property
    def source_index(self) -> NDArray[np.int64]:
        """Return the index of each frame in its source [F]."""
        return self.rows.used[:, 0].astype(np.int64)

    @property
    def submap(self) -> NDArray[np.int64]:
        """Return the submap of each frame [F]."""
        return self.rows.used[:, 5].astype(np.int64)

    @property
    def states(self) -> list[str]:
        """Return the state of each frame."""
        return [STATES[number] for number in self.rows.used[:, 6].astype(np.int64).tolist()]

    @property
    def p_off(self) -> NDArray[np.float64]:
        """Return the probability that each pose is off [F]."""
        return self.rows.used[:, 8].copy()

    def _record(self, i: int) -> Step:
        if (step := self.whole.get(i)) is not None:
            return step
        index, timestamp_s, is_keyframe, lost, splats, submap, state, component, p_off = self.rows.used[i, :NUMBERS]
        return Step(
            int(index), float(timestamp_s), self.rows.used[i, NUMBERS:].reshape(4, 4).copy(), bool(is_keyframe),
            bool(lost), {}, int(splats), int(submap), state=STATES[int(state)], component=int(component),
            p_off=float(p_off),
        )  # fmt: skip
