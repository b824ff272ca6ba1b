"""Watch a run from inside its process and show it: a copy of what has changed, at a bounded rate."""

import time
from collections.abc import Callable, Sequence

import numpy as np

from sigmasplat.drawing.colormap import Rgb
from sigmasplat.run.protocols import LoopResult, StepResult
from sigmasplat.slam.slam import Slam
from sigmasplat.viewer.finished import Show
from sigmasplat.viewer.snapshot import BUDGET, CAMERA, Path, Piece, Snapshot, bare, thinned, within_budget

EVERY_S = 2.0
MOST_SHARE = 0.02
"""Of a run's time at most this is spent on copies for the viewer: where one takes long, the next comes later."""
ACTIVE_SHARE = 1 / 3
"""Of the budget, for the submap that is being mapped; the others share the rest."""


class LiveView:
    """A watcher (`protocols.Watcher`) that shows moments of a system. It copies in the run's own thread, between two
    frames, so that nothing is read while it changes; all else is left to who shows them."""

    def __init__(
        self, slam: Slam, show: Show, title: str, budget: int = BUDGET, every_s: float = EVERY_S,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:  # fmt: skip
        self.slam, self.show, self.title, self.budget, self.every_s = slam, show, title, budget, every_s
        self._clock, self._due_s = clock, 0.0
        self._finished: tuple[Piece, ...] = ()
        self._places: dict[int, tuple[int, int]] = {}

    def __call__(self, step: StepResult) -> None:
        """Show how things are after a step, if it is time."""
        started_s = self._clock()
        if started_s >= self._due_s:
            self.show(self.moment())
            ended_s = self._clock()
            self._due_s = ended_s + max(self.every_s, (ended_s - started_s) / MOST_SHARE)

    def finishing(self, done: int, total: int) -> None:
        """Show the path and map that refinement starts from, the last submap finished."""
        if done == 0 and len(self.slam.store) == len(self.slam.atlas.anchors):
            self.show(self.moment())

    def last_loops(self, loops: Sequence[LoopResult]) -> None:
        """Show the map as it is in the end."""
        self.show(self.moment(finished=True))

    def moment(self, finished: bool = False) -> Snapshot:
        """Copy what is shown of the system as it is now; once it is finished, the final map too."""
        slam = self.slam
        lost = np.array([step.lost for step in slam.steps], np.bool_)
        submaps = np.array([step.submap for step in slam.steps], np.int64)
        path = Path(slam.atlas.T_world_camera(), lost, submaps, tuple(slam.keyframes))
        self._take_finished()
        final = Piece(None, thinned(bare(slam.field), self.budget)) if finished else None
        keyframes = slam.mapper.keyframes
        return Snapshot(
            self.title, path, final, (*self._finished, *self._active()), None,
            keyframes[0].target.camera if keyframes else CAMERA, self.picture, slam.config.render, slam.config.backend,
            live=True, status="running",
        )  # fmt: skip

    def picture(self, row: int) -> Rgb | None:
        """Return what the keyframe at a row of the path saw; None where it is too long ago."""
        for keyframe in tuple(self.slam.mapper.keyframes):
            if keyframe.index == row:
                return keyframe.target.picture().color
        if row not in self._places:
            return None
        return self.slam.store.picture(*self._places[row]).color

    def _active(self) -> tuple[Piece, ...]:
        """Return a copy of the submap that is being mapped, where it has begun."""
        slam, number = self.slam, len(self.slam.store)
        if number >= len(slam.atlas.anchors):
            return ()
        copied = thinned(bare(slam.mapper.field), int(self.budget * ACTIVE_SHARE))
        return (Piece(number, copied, slam.atlas.anchors[number].copy()),)

    def _take_finished(self) -> None:
        """Read the submaps finished since the last time, and put all where they lie now: loops move them."""
        slam, most = self.slam, int(self.budget * (1.0 - ACTIVE_SHARE))
        for index in range(len(self._finished), len(slam.store)):
            submap = slam.store.load(index)
            self._finished = (*self._finished, Piece(index, thinned(submap.field, most)))
            self._places |= {row: (index, k) for k, row in enumerate(submap.frames)}
        placed = [Piece(p.submap, p.field, slam.atlas.anchors[i].copy()) for i, p in enumerate(self._finished)]
        self._finished = within_budget(placed, most)
