"""Take snapshots of a running system from inside its process, at a bounded rate."""

import time
from collections.abc import Callable, Sequence

from sigmasplat.data.component import LOST, outside_world, states_at_end, submaps_outside
from sigmasplat.graph.loops import Loop
from sigmasplat.plugins.outputs.drawing.colormap import Rgb
from sigmasplat.plugins.viewer.finished import ShowSnapshot
from sigmasplat.plugins.viewer.snapshot import BUDGET, DEFAULT_CAMERA, CameraPath, Piece, Snapshot, thin, within_budget
from sigmasplat.run.callbacks import Callback
from sigmasplat.slam.slam import Slam
from sigmasplat.slam.step_result import Step

EVERY_S = 2.0
MAX_TIME_SHARE = 0.02
"""Maximum share of the run's time spent on copies for the viewer: a slow copy delays the next one."""
ACTIVE_SHARE = 1 / 3
"""Share of the budget for the active submap; the finished ones use the rest."""


class LiveView(Callback):
    """Shows snapshots of a system.

    It copies the map between two frames, in the thread of the run, so that no data change while they are read.
    """

    def __init__(
        self, slam: Slam, show: ShowSnapshot, title: str, budget: int = BUDGET, every_s: float = EVERY_S,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:  # fmt: skip
        self.slam, self.show, self.title, self.budget, self.every_s = slam, show, title, budget, every_s
        self._clock, self._due_s = clock, 0.0
        self._finished: tuple[Piece, ...] = ()
        self._keyframes: dict[int, tuple[int, int]] = {}

    def __call__(self, step: Step) -> None:
        """Show a snapshot after a step if one is due."""
        started_s = self._clock()
        if started_s >= self._due_s:
            self.show(self.snapshot())
            ended_s = self._clock()
            self._due_s = ended_s + max(self.every_s, (ended_s - started_s) / MAX_TIME_SHARE)

    def finishing(self, done: int, total: int) -> None:
        """Show the path and map before refinement, when the last submap is finished."""
        if done == 0 and len(self.slam.store) == len(self.slam.atlas.anchors):
            self.show(self.snapshot())

    def last_loops(self, loops: Sequence[Loop]) -> None:
        """Show the final map."""
        self.show(self.snapshot(finished=True))

    def snapshot(self, finished: bool = False) -> Snapshot:
        """Copy the current state of the system; include the final map if it is finished."""
        slam = self.slam
        lost, submaps = slam.steps.lost, slam.steps.submap
        known = [LOST if is_lost else state for is_lost, state in zip(lost, slam.steps.states, strict=True)]
        states = states_at_end(known, slam.valid())
        outside = submaps_outside(states, submaps)
        poses, keyframes = slam.atlas.T_world_camera(), tuple(slam.keyframe_indices)
        path = CameraPath(poses, lost, submaps, keyframes, outside_world(states))
        self._add_finished()
        final = Piece(None, slam.field, uncertainty=slam.uncertainty).thinned(self.budget) if finished else None
        pieces = tuple(piece for piece in (*self._finished, *self._active()) if piece.submap not in outside)
        mapped = slam.mapper.keyframes
        return Snapshot(
            self.title, path, final, pieces, None,
            mapped[0].target.camera if mapped else DEFAULT_CAMERA, self.image, slam.config.render,
            slam.config.backend, live=True, status="running",
        )  # fmt: skip

    def image(self, row: int) -> Rgb | None:
        """Return the image of the keyframe at a row of the path, or None if it is no longer kept."""
        for keyframe in tuple(self.slam.mapper.keyframes):
            if keyframe.index == row:
                return keyframe.target.picture().color
        if row not in self._keyframes:
            return None
        return self.slam.store.picture(*self._keyframes[row]).color

    def _active(self) -> tuple[Piece, ...]:
        """Return a copy of the active submap, if there is one."""
        slam, number = self.slam, len(self.slam.store)
        if number >= len(slam.atlas.anchors):
            return ()
        copied = thin(slam.mapper.field, int(self.budget * ACTIVE_SHARE))
        return (Piece(number, copied, slam.atlas.anchors[number].copy()),)

    def _add_finished(self) -> None:
        """Load the newly finished submaps, and update the poses of all submaps, since loops change them."""
        slam, most = self.slam, int(self.budget * (1.0 - ACTIVE_SHARE))
        for index in range(len(self._finished), len(slam.store)):
            submap = slam.store.load(index)
            self._finished = (*self._finished, Piece(index, thin(submap.field, most)))
            self._keyframes |= {row: (index, k) for k, row in enumerate(submap.frames)}
        placed = [Piece(p.submap, p.field, slam.atlas.anchors[i].copy()) for i, p in enumerate(self._finished)]
        self._finished = within_budget(placed, most)
