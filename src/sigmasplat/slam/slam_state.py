"""The state of SLAM, and how to read it: map, path, submaps, loops."""

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.config import Config
from sigmasplat.config.input import RENDERED
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.poses import Column
from sigmasplat.data.readout import SensorTimes
from sigmasplat.data.submap import GrowingStore, MemoryStore, OnDisk, SubmapStore
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.graph.closer import LoopCloser, make_descriptor
from sigmasplat.graph.confidence import Confidence
from sigmasplat.graph.keyframe_graph import GrowingGraph, KeyframeImages
from sigmasplat.graph.loops import Loops
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
from sigmasplat.types import Task

HOST = torch.device("cpu")


class SlamState:
    """The state of SLAM between two frames; `Slam` changes it.

    Frame 0 fixes the gauge: the world is the first camera, or that of the map that is continued. Finished submaps go to
    `store`, by default in memory.
    """

    def __init__(self, config: Config, store: GrowingStore | None = None) -> None:
        self.config = config
        self.filtered = frame_filter(self.config.input.filters)
        self.random = np.random.default_rng(self.config.seed)
        self.store: GrowingStore = MemoryStore() if store is None else store
        self.atlas = Atlas(follows=self.follows)
        self.extractor = extractor_of(self.config)
        self.tracker = Tracker.of(self.config, self.extractor)
        self.mapper = Mapper(self.config, self.random)
        self.drift = Drift(scene_scale=self.config.render.scene_scale)
        self.validation_views = ValidationViews(self.config.uncertainty.probes, self.config.mapping.every)
        self.descriptor = make_descriptor(self.config.loops)
        self.closer = LoopCloser(self.config, self.store, self.tracker.extractor)
        self.recovery = Recovery(self.config.recovery)
        self.graph, self.images = self._new_graph(), KeyframeImages()
        self.tracker.times = self.graph.times
        self.confidence = Confidence()
        self.relocaliser = Relocaliser(self.config, self.extractor)
        self.steps = Steps()
        self.keyframe_indices: list[int] = []
        self._view: View | None = None
        self._resample = False
        self._timer = StepTimer()
        self._search: Task[None] | None = None
        self.keep_on_disk()

    @property
    def field(self) -> GaussianField:
        """Return the map in the world, in host memory: all submaps side by side."""
        if not len(self.store):
            return self.mapper.field.to(HOST)
        return merged_field(self.store, self.atlas, 0, self.mapper.field)

    @property
    def sensor_times(self) -> SensorTimes:
        """Return when the sensor reads depth and rows, as far as the keyframes have shown it."""
        return self.graph.times

    def active_submap(self) -> SubmapState:
        """Return a copy of the active submap's state, as steps report it."""
        atlas, splats = self.atlas, len(self.mapper.field)
        return SubmapState(len(atlas.anchors) - 1, atlas.components[-1], atlas.anchors[-1], splats)

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

    def view_for(self, frame: Frame) -> View:
        """Return the view; the first frame makes it, if `prepare` has not."""
        return self._view or self.prepare(working_frame(frame, self.config).camera)

    def observed(self, frame: Frame, view: View, extractor: Extractor | None) -> PreparedFrame:
        """Resize a frame to working size and prepare it for the fits. Raises SourceError if it comes from another
        camera than the first."""
        frame = self.filtered(frame)
        working = working_frame(frame, self.config, view.camera if self._resample else None)
        if working.camera != view.camera:
            raise SourceError(f"frame {frame.index} comes from another camera ({working.camera}) than the first")
        return observe(frame, working, view, extractor)

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

    def _new_graph(self) -> GrowingGraph:
        c, times = self.config, SensorTimes.given(self.config.input.calibrate)
        if times.std_s and (c.tracking.method != "align" or c.tracking.fit_depth):
            raise ConfigError("input.calibrate with a file needs tracking.method=align and depth that is not predicted")
        measures = c.input.calibrate == "auto" and c.input.sensor != RENDERED and not c.tracking.fit_depth
        return GrowingGraph(c.loops.alignments, measures, times=times)

    @property
    def _describes(self) -> bool:
        m = self.config.mapping
        return (self.cuts and self.config.loops.close) or (m.window > 2 and m.covisibility == "descriptor")


def merged_field(store: SubmapStore, atlas: Atlas, component: int, active: GaussianField) -> GaussianField:
    """Return the splats of all submaps of a component side by side, in its frame, in host memory; `active` are those of
    the submap that is not finished."""
    fields = ((store.load(s).field if s < len(store) else active.to(HOST), s) for s in atlas.members(component))
    return GaussianField.side_by_side(field.moved(torch.from_numpy(atlas.anchors[s])) for field, s in fields)
