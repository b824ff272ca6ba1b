"""Take snapshots: of a run folder, and at a bounded rate of a system that runs in this process."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

import sigmasplat.api as api
from sigmasplat.api import Camera, Matrix
from sigmasplat.plugins.outputs.drawing.colormap import Rgb
from sigmasplat.plugins.outputs.first_look import VIEWS, best_view, sure
from sigmasplat.plugins.outputs.floorplan.ground import Up, floor_frame, sample_surfaces, up_of
from sigmasplat.plugins.viewer.snapshot import (
    BUDGET,
    DEFAULT_CAMERA,
    CameraPath,
    Opening,
    Piece,
    Snapshot,
    field_without_moments,
    thin,
    within_budget,
)

if TYPE_CHECKING:
    from sigmasplat.api import Loop, Slam, Step

EVERY_S = 2.0
ShowSnapshot = Callable[[Snapshot], None]


def finished_snapshot(run: api.RunFolder, budget: int = BUDGET) -> Snapshot:
    """Read the snapshot of a finished run.

    Raises RunError if the run stopped before it had a map, or if its uncertainty belongs to another map.
    """
    final, frames, tensors = run.read_map(), run.read_frames(), run.read_checkpoint()[0]
    splats = field_without_moments(final.params, {name: rows.params for name, rows in final.attributes.items()})
    config, true_file = run.config(), run.path / api.TRUTH
    cache = SubmapCache(run.submaps, budget)
    cache.load(np.asarray(tensors["T_world_submap"], np.float64))  # for the images of keyframes
    camera = cache.camera or DEFAULT_CAMERA
    piece = final_piece(splats, run.uncertainty_of(final), frames.path.T_world_camera)
    return Snapshot(
        run.path.resolve().name,
        _final_path(frames, tensors),
        piece,
        (),
        api.read_poses(true_file).T_world_camera[:, :3, 3] if true_file.is_file() else None,
        camera,
        cache.image,
        config.render,
        config.backend,
        status=str(run.facts().get("status")),
        opening=opening(piece, frames.path, camera, config, up_of(frames.path.T_world_camera, run.facts())),
    )


def final_piece(splats: api.GaussianField, known: api.MapUncertainty | None, T_world_camera: Matrix) -> Piece:
    """Return a final map as a piece; T_world_camera [F, 4, 4]: the poses that it was made from."""
    return Piece(None, splats, uncertainty=known, sure=sure(splats, known, T_world_camera[:, :3, 3]))


def opening(piece: Piece, path: api.Trajectory, camera: Camera, config: api.Config, up: Up) -> Opening | None:
    """Return the view of the run that opens its map; None if it sees nothing from its path."""
    field = piece.field if piece.sure is None else piece.field.part(piece.sure)
    renderer = api.FieldRenderer(config.render, config.backend)
    try:
        samples = list(sample_surfaces(field, path, camera, renderer, VIEWS))
        T_floor_world = floor_frame(samples, up)
    except api.SigmaSplatError:
        return None
    T, points = samples[best := best_view(samples)].T_world_camera, samples[best].points
    ahead_m = float(np.median((points - T[:3, 3]) @ T[:3, 2]))
    return Opening(T, ahead_m, camera, T_floor_world[2, :3])


class SubmapCache:
    """The finished submaps that have been read so far, within a budget of splats, and the images of their keyframes."""

    def __init__(self, store: api.SubmapStore, budget: int = BUDGET) -> None:
        self.store, self.budget = store, budget
        self.pieces: dict[int, Piece] = {}
        self.camera: Camera | None = None
        self._keyframes: dict[int, tuple[int, int]] = {}

    def load(self, T_world_submap: Sequence[Matrix] | Matrix) -> None:
        """Read the submaps that were not read before and have a pose."""
        for index in range(len(self.pieces), min(len(self.store), len(T_world_submap))):
            submap = self.store.load(index)
            self.camera = submap.camera
            self.pieces[index] = Piece(index, thin(submap.field, self.budget), T_world_submap[index])
            fitting = within_budget(tuple(self.pieces.values()), self.budget)
            self.pieces = dict(zip(self.pieces, fitting, strict=True))
            for k, row in enumerate(submap.frames):
                self._keyframes.setdefault(row, (index, k))

    def image(self, row: int) -> Rgb | None:
        """Return the image of the keyframe at a row of the path, or None if its submap was not read."""
        if row not in self._keyframes:
            return None
        return self.store.picture(*self._keyframes[row]).color


def _final_path(frames: api.RunFrames, tensors: Mapping[str, Tensor]) -> CameraPath:
    """Return the path of a finished run: valid poses from trajectory.txt, the others from the checkpoint."""
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    kept = np.asarray(tensors["T_world_camera"], np.float64)[: len(frames)]
    poses[: len(kept)] = kept
    poses[frames.rows] = frames.path.T_world_camera
    keyframes = tuple(row for row in tensors["keyframes"].tolist() if row < len(frames))
    lost = np.array([bool(record.get("lost")) for record in frames.log], np.bool_)
    submaps = np.array([record.get("submap", 0) for record in frames.log], np.int64)
    return CameraPath(poses, lost, submaps, keyframes, frames.outside())


MAX_TIME_SHARE = 0.02
"""Maximum share of the run's time spent on copies for the viewer: a slow copy delays the next one."""
ACTIVE_SHARE = 1 / 3
"""Share of the budget for the active submap; the finished ones use the rest."""


class LiveView(api.Callback):
    """Shows snapshots of a system.

    It copies the map between two frames, in the thread of the run, so that no data change while they are read.
    """

    def __init__(
        self, slam: "Slam", show: ShowSnapshot, title: str, budget: int = BUDGET, every_s: float = EVERY_S,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:  # fmt: skip
        self.slam, self.show, self.title, self.budget, self.every_s = slam, show, title, budget, every_s
        self._clock, self._due_s = clock, 0.0
        self._finished = SubmapCache(slam.store, int(budget * (1.0 - ACTIVE_SHARE)))

    def __call__(self, step: "Step") -> None:
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

    def last_loops(self, loops: "Sequence[Loop]") -> None:
        """Show the final map."""
        self.show(self.snapshot(finished=True))

    def snapshot(self, finished: bool = False) -> Snapshot:
        """Copy the current state of the system; include the final map if it is finished."""
        slam = self.slam
        lost, submaps = slam.steps.lost, slam.steps.submap
        known = [api.LOST if is_lost else state for is_lost, state in zip(lost, slam.steps.states, strict=True)]
        states = api.states_at_end(known, slam.valid())
        outside = api.submaps_outside(states, submaps)
        poses, keyframes = slam.atlas.T_world_camera(), tuple(slam.keyframe_indices)
        path = CameraPath(poses, lost, submaps, keyframes, api.outside_world(states))
        anchors = slam.atlas.anchors
        self._finished.load(anchors)
        placed = [replace(piece, T_world_piece=anchors[i].copy()) for i, piece in self._finished.pieces.items()]
        inside = poses[~(path.lost | ~path.inside)]
        final = final_piece(slam.field, slam.uncertainty, inside).thinned(self.budget) if finished else None
        pieces = tuple(piece for piece in (*placed, *self._active()) if piece.submap not in outside)
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
        return self._finished.image(row)

    def _active(self) -> tuple[Piece, ...]:
        """Return a copy of the active submap, if there is one."""
        slam, number = self.slam, len(self.slam.store)
        if number >= len(slam.atlas.anchors):
            return ()
        copied = thin(slam.mapper.field, int(self.budget * ACTIVE_SHARE))
        return (Piece(number, copied, slam.atlas.anchors[number].copy()),)
