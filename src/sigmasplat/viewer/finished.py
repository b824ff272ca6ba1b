"""Read what is shown of a run folder: of a run that has ended, or of one that goes on in another process."""

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.drawing.colormap import Rgb
from sigmasplat.errors import RunError, SigmaSplatError
from sigmasplat.io.runs import TRUTH, RunFolder
from sigmasplat.io.trajectory import read_trajectory
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.sources.base import Source
from sigmasplat.types import Matrix
from sigmasplat.viewer.snapshot import BUDGET, CAMERA, Path, Piece, Snapshot, bare, thinned, within_budget

EVERY_S = 2.0
Log = list[dict[str, Any]]
Show = Callable[[Snapshot], None]


def ended(run: RunFolder, source: Source | None = None, budget: int = BUDGET) -> Snapshot:
    """Return what there is of a run that has ended; `source` gives pictures of keyframes that the run did not keep.

    Raises RunError if it stopped before it had a map.
    """
    path, final, tensors = run.read_trajectory(), run.read_map(), run.read_checkpoint()[0]
    log, config, true_file = run.read_log(), run.config(), run.path / TRUTH
    kept = min(len(path), len(log))
    keyframes = tuple(row for row in tensors["keyframes"].tolist() if row < kept)
    shelf = Shelf(run, budget)
    shelf.take_all(np.asarray(tensors["T_world_submap"], np.float64))
    pieces = list(shelf.pieces.values())
    if pieces and len(pieces) < len(tensors["T_world_submap"]):
        active = GaussianField(tensors["params"])
        pieces.append(Piece(len(pieces), thinned(active, budget), np.asarray(tensors["T_world_submap"][-1])))
    return Snapshot(
        run.path.resolve().name,
        Path(path.T_world_camera[:kept], *_marks(log[:kept]), keyframes),
        Piece(None, bare(final)),
        within_budget(pieces, budget),
        read_trajectory(true_file).T_world_camera[:, :3, 3] if true_file.is_file() else None,
        _camera(run, shelf, source),
        partial(_picture, shelf, log, run, source),
        config.render,
        config.backend,
        status=str(run.facts().get("status")),
    )


def running(run: RunFolder, shelf: "Shelf") -> Snapshot:
    """Return what a run has written so far: the log's path, and the submaps finished, which lie where the log has
    their first keyframes. `shelf` keeps what has been read before."""
    log = run.read_log() if (run.path / "log.jsonl").is_file() else []
    config, poses = run.config(), [np.array(record["T_world_camera"], np.float64) for record in log]
    shelf.take(poses)
    path = Path(
        np.array(poses).reshape(-1, 4, 4), *_marks(log), tuple(r for r, x in enumerate(log) if x["is_keyframe"])
    )
    return Snapshot(
        run.path.resolve().name, path, None, tuple(shelf.pieces.values()), None, shelf.camera or CAMERA, shelf.picture,
        config.render, config.backend, live=True, status="running",
    )  # fmt: skip


def follow(run: RunFolder, show: Show, stop: threading.Event, source: Source | None = None) -> None:
    """Show a run folder; while its run goes on, again and again, and at last as it has ended. Returns then, or once
    `stop` is set. Raises RunError where a run that has ended has no map."""
    shelf = Shelf(run)
    while run.facts().get("status") == "running":
        show(running(run, shelf))
        if stop.wait(EVERY_S):
            return
    show(ended(run, source))


class Shelf:
    """Keep the finished submaps of a run as they are read, within a budget of splats, and find their pictures."""

    def __init__(self, run: RunFolder, budget: int = BUDGET) -> None:
        self.store, self.budget = run.submaps, budget
        self.pieces: dict[int, Piece] = {}
        self.camera: Camera | None = None
        self._places: dict[int, tuple[int, int]] = {}

    def take(self, T_world_camera: list[Matrix]) -> None:
        """Read the submaps not read before, whose first keyframes have a pose."""
        for index in range(len(self.pieces), len(self.store)):
            self._add(index, lambda first: T_world_camera[first] if first < len(T_world_camera) else None)

    def take_all(self, T_world_submap: NDArray[np.float64]) -> None:
        """Read all submaps that lie somewhere."""
        for index in range(min(len(self.store), len(T_world_submap))):
            self._add(index, lambda first, T=T_world_submap[index]: T)  # type: ignore[misc]

    def picture(self, row: int) -> Rgb | None:
        """Return what the keyframe at a row of the path saw, where its submap is here."""
        if row not in self._places:
            return None
        return self.store.picture(*self._places[row]).color

    def _add(self, index: int, anchor_of: Callable[[int], Matrix | None]) -> None:
        submap = self.store.load(index)
        T_world_submap = anchor_of(submap.frames[0])
        if T_world_submap is None or index != len(self.pieces):
            return
        self.camera = submap.camera
        self.pieces[index] = Piece(index, thinned(submap.field, self.budget), T_world_submap)
        fitting = within_budget(tuple(self.pieces.values()), self.budget)
        self.pieces = dict(zip(self.pieces, fitting, strict=True))
        for k, row in enumerate(submap.frames):
            self._places.setdefault(row, (index, k))


def _marks(log: Log) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return which frames were lost, and their submaps."""
    lost = np.array([bool(record.get("lost")) for record in log], np.bool_)
    return lost, np.array([record.get("submap", 0) for record in log], np.int64)


def _camera(run: RunFolder, shelf: Shelf, source: Source | None) -> Camera:
    """Return the camera of the images that the run worked on, as far as it can be told."""
    if shelf.camera:
        return shelf.camera
    settings = run.config().input
    return source.camera.prepared(settings.width, settings.crop_px) if source else CAMERA


def _picture(shelf: Shelf, log: Log, run: RunFolder, source: Source | None, row: int) -> Rgb | None:
    """Return what a keyframe saw: from its submap, else from the sequence where it still is."""
    kept = shelf.picture(row)
    if kept is not None or source is None or row >= len(log):
        return kept
    s = run.config().input
    try:
        frame = source.frame(log[row]["index"]).prepared(s.width, s.min_depth_m, s.max_depth_m, s.crop_px)
    except SigmaSplatError:
        return None
    return (frame.color * 255.0).round().astype(np.uint8)


def refuse_mapless(run: RunFolder) -> None:
    """Raise RunError if a run has ended without a map."""
    if run.facts().get("status") != "running" and not (run.path / "map.ply").is_file():
        raise RunError(f"run {run.path} has no map to show: it stopped before its first frame; run it again")
