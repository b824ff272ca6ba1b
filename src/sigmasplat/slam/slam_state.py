"""The state of SLAM, and how to read it: map, path, components, checkpoint."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.data.frame import Frame
from sigmasplat.data.poses import Column
from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.data.submap import MemoryStore, OnDisk, SubmapStore
from sigmasplat.data.trajectory import LOST, Component, Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.graph.closer import LoopCloser, make_descriptor
from sigmasplat.graph.confidence import Confidence
from sigmasplat.graph.growing_graph import GrowingGraph, KeyframeImages
from sigmasplat.graph.loops import Loop, Loops
from sigmasplat.graph.newest_covariance import NewestCovariance, PoseErrors
from sigmasplat.graph.path_covariance import recorded
from sigmasplat.mapping.mapper import Mapper
from sigmasplat.mapping.window import ValidationViews
from sigmasplat.render.view import View
from sigmasplat.slam.results import Step, Steps, StepTimer, SubmapState
from sigmasplat.tracking.depth_filters import frame_filter
from sigmasplat.tracking.drift import Drift
from sigmasplat.tracking.features import Extractor, extractor_of
from sigmasplat.tracking.prepared_frame import PreparedFrame, observe, view_of, working_frame
from sigmasplat.tracking.recovery import Recovery
from sigmasplat.tracking.relocaliser import Relocaliser
from sigmasplat.tracking.tracker import Tracker
from sigmasplat.types import Matrix, Task

HOST = torch.device("cpu")


class SlamState:
    """The state of SLAM between two frames; `Slam` changes it.

    Frame 0 fixes the gauge: the world is the first camera, or that of the map that is continued. Finished submaps go to
    `store`, by default in memory.
    """

    def __init__(self, config: Config, store: SubmapStore | None = None) -> None:
        self.config = config
        self.filtered = frame_filter(self.config.input.filters)
        self.random = np.random.default_rng(self.config.seed)
        self.store = MemoryStore() if store is None else store
        self.atlas = Atlas(follows=self.follows)
        self.extractor = extractor_of(self.config)
        self.tracker = Tracker.of(self.config, self.extractor)
        self.mapper = Mapper(self.config, self.random)
        self.drift = Drift(scene_scale=self.config.render.scene_scale)
        self.validation_views = ValidationViews(self.config.uncertainty.probes, self.config.mapping.every)
        self.descriptor = make_descriptor(self.config.loops)
        self.closer = LoopCloser(self.config, self.store, self.tracker.extractor)
        self.recovery = Recovery(self.config.recovery)
        self.graph, self.images = GrowingGraph(self.config.loops.alignments), KeyframeImages()
        self.confidence = Confidence()
        self.relocaliser = Relocaliser(self.config, self.extractor)
        self.steps = Steps()
        self.keyframe_indices: list[int] = []
        self._view: View | None = None
        self._resample = False
        self._timer = StepTimer()
        self._search: Task[list[Loop]] | None = None
        self._newest_covariance = NewestCovariance()
        self.keep_on_disk()

    @property
    def field(self) -> GaussianField:
        """Return the map in the world, in host memory: all submaps side by side."""
        if not len(self.store):
            return self.mapper.field.to(HOST)
        return merged_field(self.store, self.atlas, 0, self.mapper.field)

    def active_submap(self) -> SubmapState:
        """Return a copy of the active submap's state, as steps report it."""
        atlas, splats = self.atlas, len(self.mapper.field)
        drift = replace(self.drift)
        return SubmapState(len(atlas.anchors) - 1, atlas.components[-1], atlas.anchors[-1], drift, splats)

    def components(self) -> list[Component]:
        """Return the components of the atlas that are not connected to the world."""
        return components_apart(self.store, self.atlas, self.mapper.field, self.trajectory(), ~self.steps.lost)

    @property
    def loops(self) -> Loops:
        """Return every pair of submaps that was tried as a loop, with the latest verdict. It grows with the map."""
        return self.closer.loops

    def keep_on_disk(self) -> None:
        """Let what grows with every frame move from RAM to the folder of the store, if it has one: a file without a
        name, which is gone when the process ends."""
        folder = self.store.folder if isinstance(self.store, OnDisk) else None
        for column in self._columns:
            column.folder = folder

    def release(self) -> None:
        """Give the RAM of what is on disk back to the system, after the whole history was read."""
        for column in self._columns:
            column.release()

    @property
    def _columns(self) -> tuple[Column, ...]:
        return *self.atlas.columns, self.steps.rows, self.graph.edges.rows, *self.closer.columns

    def trajectory(self) -> Trajectory:
        """Return the poses of all frames so far, including lost ones (the log marks them).

        A frame is stored relative to the newest keyframe at its time, and a keyframe relative to its submap. A frame
        therefore moves when mapping moves its keyframe, or a loop moves its submap.
        """
        return Trajectory(self.steps.timestamps_s, self.atlas.T_world_camera())

    def valid(self) -> NDArray[np.bool_]:
        """Return whether the pose of each frame so far is valid [F]: not lost, and connected to the world."""
        return self.atlas.in_world & ~self.steps.lost

    def newest_step(self) -> Step | None:
        """Return the result of the newest frame; None before the first one."""
        return self.steps[-1] if self.steps else None

    def covariance(self) -> Matrix | None:
        """Return the covariance [6, 6] of the newest frame's pose; None if that frame is lost.

        Order: position x, y, z (m), then rotation about x, y, z (rad), all in the axes of the world, as in
        geometry_msgs/PoseWithCovariance. It covers the noise and the systematic error of tracking since the first
        camera of the component, its disagreement with mapping, and what closed loops corrected (`path_covariance`). It
        does not cover a wrong pose that tracking did not notice: `Step.p_off` is its probability. For the first frame
        it is 0. Raises SourceError before the first frame.
        """
        newest = self.newest_step()
        if newest is None:
            raise SourceError("no pose yet: give a frame to `track` or `step` first")
        if newest.state == LOST:
            return None
        T_world_camera = (
            self.atlas.anchors[-1] @ self.atlas.keyframe_poses.last[-1] @ self.atlas.places[-1].T_keyframe_camera
        )
        return self.pose_errors().of(T_world_camera, int(not newest.is_keyframe))

    def pose_errors(self) -> PoseErrors:
        """Return the errors of poses relative to the newest keyframe."""
        return self._newest_covariance.errors(self.atlas, self.closer)

    def checkpoint(self) -> dict[str, Tensor]:
        """Return what is needed to read a run back, in host memory: the active submap's field with its optimiser state,
        poses, times, keyframes, anchors, the submap of each frame, and the errors of the path (`path_covariance`)."""
        path, edges = self.trajectory(), self.closer.valid
        return checkpoint_of(self.mapper.field, path, self.atlas, self.keyframe_indices, edges)

    @property
    def view(self) -> View:
        """Return the view that renders for this run's camera. Raises SourceError before the first frame."""
        if self._view is None:
            raise SourceError("no camera yet: give a frame to `step` first")
        return self._view

    def prepare(self, camera: Camera, resample: bool = False) -> View:
        """Make the view for the images of a camera with the size of `Frame.prepared`. The first frame calls this
        too. With `resample`, frames of another camera are accepted and resampled to this one."""
        self._resample, self._view = resample, view_of(camera, self.config)
        return self._view

    @property
    def is_prepared(self) -> bool:
        """Return whether there is a view yet."""
        return self._view is not None

    def observed(self, frame: Frame, view: View, extractor: Extractor | None) -> PreparedFrame:
        """Resize a frame to working size and prepare it for the fits. Raises SourceError if it comes from another
        camera than the first."""
        frame = self.filtered(frame)
        working = working_frame(frame, self.config, view.camera if self._resample else None)
        if working.camera != view.camera:
            raise SourceError(f"frame {frame.index} comes from another camera ({working.camera}) than the first")
        return observe(frame, working, view, self.config, extractor)

    def start_timer(self) -> StepTimer:
        """Measure the stages from now on; return the timer."""
        self._timer = StepTimer()
        self._timer.start_kernels(self.view)
        return self._timer

    def settle(self) -> None:
        """Wait until finished submaps are on the disk. `step` does all other work on its frame, and the next frames, or
        `finish`, do what it owes. Raises RunError if a submap cannot be written."""
        if isinstance(self.store, OnDisk):
            self.store.settle()

    @property
    def cuts(self) -> bool:
        """Return whether any rule may end a submap."""
        s = self.config.submaps
        return bool(s.distance_m or s.angle_deg or s.frames or s.uncertainty_m)

    @property
    def follows(self) -> bool:
        """Return whether keyframes are aligned to each other, and the map follows their graph."""
        c = self.config
        return c.loops.close and c.final.move_poses and not c.input.poses

    @property
    def _describes(self) -> bool:
        m = self.config.mapping
        return (self.cuts and self.config.loops.close) or (m.window > 2 and m.covisibility == "descriptor")


def checkpoint_of(
    active: GaussianField, path: Trajectory, atlas: Atlas, keyframes: Sequence[int], edges: Sequence[RelativePose]
) -> dict[str, Tensor]:
    """Return the active submap's field with its attributes and its optimiser state, poses, times, keyframes, anchors,
    the submap of each frame, the exposures of frames if they are known, and the errors of the path, in host
    memory."""
    return {
        **_rows_of(active, ""),
        **{key: part for name, rows in active.attributes.items() for key, part in _rows_of(rows, f"{name}_").items()},
        "timestamps_s": torch.from_numpy(path.timestamps_s),
        "T_world_camera": torch.from_numpy(path.T_world_camera),
        "T_world_camera_odometry": torch.from_numpy(atlas.T_world_camera(loops=False)),
        "T_world_keyframe": torch.from_numpy(atlas.T_world_keyframes),
        "T_submap_camera": torch.from_numpy(atlas.T_submap_camera),
        **path_errors(atlas, keyframes, edges),
    }


def path_errors(atlas: Atlas, keyframes: Sequence[int], edges: Sequence[RelativePose]) -> dict[str, Tensor]:
    """Return the part of a checkpoint that `PathCovariance.of` reads; arguments as for `checkpoint_of`."""
    return {
        "keyframes": torch.tensor(keyframes, dtype=torch.int64),
        "T_world_submap": torch.from_numpy(np.array(atlas.anchors)),
        "submap_component": torch.tensor(atlas.components, dtype=torch.int64),
        "frame_submap": torch.tensor(atlas.places.submap),
        **({"exposure": torch.from_numpy(atlas.frame_exposures())} if atlas.exposures else {}),
        **recorded(atlas, edges),
    }


def _rows_of(rows: Rows, prefix: str) -> dict[str, Tensor]:
    """Return the parameters and the optimiser state of rows, in host memory, with a prefix to each name."""
    parts = {f"{prefix}{name}": getattr(rows, name).cpu() for name in ("params", "moment1", "moment2", "last_step")}
    return parts | {f"{prefix}adam_steps": torch.tensor(rows.steps)}


def merged_field(store: SubmapStore, atlas: Atlas, component: int, active: GaussianField) -> GaussianField:
    """Return the splats of all submaps of a component side by side, in its frame, in host memory; `active` are those of
    the submap that is not finished."""
    fields = (
        (store.load(s).field if s < len(store) else active.to(torch.device("cpu"))).moved(
            torch.from_numpy(atlas.anchors[s])
        )
        for s in atlas.members(component)
    )
    return GaussianField.side_by_side(fields)


def components_apart(
    store: SubmapStore, atlas: Atlas, active: GaussianField, trajectory: Trajectory, found: NDArray[np.bool_]
) -> list[Component]:
    """Return the components that are not connected to the world; trajectory: of all frames, found [F]: not lost."""
    component_of = np.array(atlas.components, np.int64)[atlas.places.submap]
    return [
        Component(n, merged_field(store, atlas, n, active), trajectory.at(found & (component_of == n)))
        for n in sorted(set(atlas.components) - {0})
    ]
