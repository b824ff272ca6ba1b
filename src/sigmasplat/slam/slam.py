"""SLAM: track every frame, map keyframes, cut submaps, close loops. `Slam.step` follows the papers' overviews."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.errors import SourceError
from sigmasplat.fit.pose import PoseFit
from sigmasplat.model import se3
from sigmasplat.model.atlas import Atlas
from sigmasplat.model.camera import Camera
from sigmasplat.model.component import APART, LOST, RELOCALISED, TRACKED, Component
from sigmasplat.model.field import GaussianField
from sigmasplat.model.frame import Frame
from sigmasplat.model.submap import MemoryStore, StorePart, SubmapStore
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.presets import default_preset, preset
from sigmasplat.render.backend import make_view
from sigmasplat.render.view import View
from sigmasplat.slam.drift import Drift
from sigmasplat.slam.features import make_extractor
from sigmasplat.slam.final import final_map
from sigmasplat.slam.found import Found
from sigmasplat.slam.localisation.known_map import KnownMap
from sigmasplat.slam.localisation.recovery import Link, Recovery, usable
from sigmasplat.slam.localisation.relocaliser import INDEX_AT_MOST, Relocaliser, Relocation
from sigmasplat.slam.localisation.sight import Sight, sight_of, working_frame
from sigmasplat.slam.loop_closure.closer import Loop, LoopCloser, make_descriptor
from sigmasplat.slam.mapper import Mapper
from sigmasplat.slam.merged import merged_field
from sigmasplat.slam.rules import ends_submap, is_keyframe
from sigmasplat.slam.step_result import Step, StepTimer
from sigmasplat.slam.tracker import Tracker
from sigmasplat.types import Matrix, no_progress

HOST = torch.device("cpu")


@dataclass(eq=False)
class Observation(Sight):
    """A frame as the system sees it: the working images, and the forms that tracking needs."""

    frame: Frame = field(kw_only=True)


class Slam:
    """Simultaneous localisation and mapping: give frames to `step`, then call `finish`; read `field` and `trajectory()`
    at any time.

    Frame 0 fixes the gauge: the world is the first camera. No part of this class reads ground truth. Finished submaps
    go to `store`, by default in memory.
    """

    def __init__(self, config: Config | None = None, store: SubmapStore | None = None) -> None:
        self.config = config or preset(default_preset())
        self.random = np.random.default_rng(self.config.seed)
        self.store = MemoryStore() if store is None else store
        self.atlas = Atlas()
        wanted = self.config.tracking.features or self.config.recovery.relocalise
        self.extractor = make_extractor(self.config.features) if wanted else None
        self.tracker = Tracker(self.config.tracking, self.extractor if self.config.tracking.features else None)
        self.mapper = Mapper(self.config, self.random)
        self.drift = Drift()
        self.descriptor = make_descriptor(self.config.loops)
        self.closer = LoopCloser(self.config, self.store)
        self.recovery = Recovery(self.config.recovery)
        self.relocaliser = Relocaliser(self.config, self.extractor)
        self.steps: list[Step] = []
        self.keyframe_indices: list[int] = []
        self._view: View | None = None
        self._resample = False
        self._final: GaussianField | None = None
        self._timer = StepTimer()

    def step(self, frame: Frame) -> Step:
        """Process one frame: track it, find it in the whole map if it is lost, map it if it is a keyframe, and cut the
        submap if a rule ends it here.

        Raises SourceError if the first frame has no depth or a later one comes from another camera.
        """
        self._timer = StepTimer()
        seen = self._observe(frame)
        found = self._localise(seen) if self.steps else self._begin(seen)
        if found.mapped:
            found.T_submap_camera = self._map(seen, found.T_submap_camera)
            if self._submap_ends(found.T_submap_camera):
                found.loops += self._cut(found.T_submap_camera)
                found.T_submap_camera = self._map(seen, np.eye(4))  # the next submap begins with the same keyframe
            self._seek_component(seen, found)
        self.atlas.place_frame(found.T_submap_camera)
        self.steps.append(self._step_result(seen.frame, found))
        return self.steps[-1]

    def finish(self, progress: Callable[[int, int], None] = no_progress) -> None:
        """Finish the last submap, look for its loops, and make the final map (VarSplat §7); call it once, at the end.

        Calls `progress(done, total)` with the steps of refinement, from 0 to the last one; without refinement the total
        is 1. Does nothing when no rule cuts submaps and `final.iterations` is 0. Components that are not connected to
        the world are left out of the final map.
        """
        if not self.steps or not (len(self.store) or self._cuts or self.config.final.iterations):
            return
        total = self.config.final.iterations or 1
        progress(0, total)
        self._finish_submap()
        members = self.atlas.members(0)
        store, anchors = StorePart(self.store, members), [self.atlas.anchors[s] for s in members]
        self._final = final_map(store, anchors, self.config, self.view, self.random, progress)
        progress(total, total)

    @property
    def field(self) -> GaussianField:
        """Return the map in the world, in host memory: the final map after `finish`, before that all submaps side by
        side."""
        if self._final is not None:
            return self._final
        if not len(self.store):
            return self.mapper.field.to(HOST)
        return merged_field(self.store, self.atlas, 0, self.mapper.field)

    def components(self) -> list[Component]:
        """Return the components of the atlas that are not connected to the world."""
        numbers = sorted(set(self.atlas.components) - {0})
        return [self._component(number) for number in numbers]

    def _component(self, number: int) -> Component:
        place_of = [self.atlas.components[place.submap] == number for place in self.atlas.places]
        tracked = np.array(place_of) & np.array([not step.lost for step in self.steps])
        field = merged_field(self.store, self.atlas, number, self.mapper.field)
        return Component(number, field, self.trajectory().at(tracked))

    @property
    def loops(self) -> list[Loop]:
        """Return every pair of submaps that was tried as a loop, with the latest verdict."""
        return list(self.closer.loops)

    def trajectory(self) -> Trajectory:
        """Return the poses of all frames so far, including lost ones (the log marks them).

        A frame is stored relative to the newest keyframe at its time, and a keyframe relative to its submap. A frame
        therefore moves when mapping moves its keyframe, or a loop moves its submap.
        """
        return Trajectory(np.array([s.timestamp_s for s in self.steps]), self.atlas.T_world_camera())

    def believed(self) -> NDArray[np.bool_]:
        """Return whether the pose of each frame so far is believed [F]: not lost, and connected to the world."""
        return self.atlas.in_world & np.array([not step.lost for step in self.steps], np.bool_)

    def checkpoint(self) -> dict[str, Tensor]:
        """Return what is needed to read a run back, in host memory: the active submap's field with its optimiser state,
        poses, times, keyframes, anchors, and the submap of each frame."""
        path, active = self.trajectory(), self.mapper.field
        return {
            **{name: getattr(active, name).cpu() for name in ("params", "moment1", "moment2", "last_step")},
            "adam_steps": torch.tensor(active.steps),
            "timestamps_s": torch.from_numpy(path.timestamps_s),
            "T_world_camera": torch.from_numpy(path.T_world_camera),
            "T_world_camera_odometry": torch.from_numpy(self.atlas.T_world_camera(loops=False)),
            "keyframes": torch.tensor(self.keyframe_indices, dtype=torch.int64),
            "T_world_submap": torch.from_numpy(np.array(self.atlas.anchors).reshape(-1, 4, 4)),
            "submap_component": torch.tensor(self.atlas.components, dtype=torch.int64),
            "frame_submap": torch.tensor([place.submap for place in self.atlas.places], dtype=torch.int64),
        }

    @property
    def view(self) -> View:
        """Return the view that renders for this run's camera. Raises SourceError before the first frame."""
        if self._view is None:
            raise SourceError("no camera yet: give a frame to `step` first")
        return self._view

    def prepare(self, camera: Camera, resample: bool = False) -> View:
        """Make the view for the images of a camera with the size of `Frame.prepared`. The first frame calls this
        too. With `resample`, frames of another camera are accepted and resampled to this one."""
        self._resample, c = resample, self.config
        learned = bool(c.mapping.weight_nll_color or c.mapping.weight_nll_depth)
        read = c.tracking.uncertainty and c.tracking.align_depth_by == "V"
        self._view = make_view(c.backend, camera, c.render, variance=learned or read)
        return self._view

    def _observe(self, frame: Frame) -> Observation:
        """Resize a frame to working size and prepare it for the fits."""
        with self._timer.stage("prepare"):
            view = self._view or self.prepare(working_frame(frame, self.config).camera)
            working = working_frame(frame, self.config, view.camera if self._resample else None)
            if working.camera != view.camera:
                raise SourceError(f"frame {frame.index} comes from another camera ({working.camera}) than the first")
            self._timer.start_kernels(view)
            seen = sight_of(frame, working, view, self.config, self.extractor)
            return Observation(seen.target, seen.live, seen.image, frame=working)

    def _begin(self, seen: Observation) -> Found:
        """Start the first submap at the first frame. Its camera is the world, unless there are earlier submaps: then
        it is connected to the place where it is found, or begins a new component."""
        if not (seen.frame.depth_m > 0).any():
            raise SourceError(
                f"frame {seen.frame.index} has no depth reading in [{self.config.input.min_depth_m}, "
                f"{self.config.input.max_depth_m}] m to start a map from; check the depth scale or start at a later one"
            )
        self.tracker.start(seen)
        place = self._relocalise(seen, index_at_most=None) if self.atlas.anchors else None
        if place is None:
            self.atlas.begin_submap()
            return Found(np.eye(4), TRACKED, mapped=True)
        self._begin_at(place.where[0], place.T_submap_camera, place.information, self._splats_of(place))
        return Found(np.eye(4), RELOCALISED, place.values(), mapped=True)

    def _localise(self, seen: Observation) -> Found:
        """Track a frame; if it is lost, search the whole map for it; if that fails too often, begin a new map."""
        fit = self._track(seen)
        lost = self.tracker.lost
        self.recovery.count(lost, self.tracker.doubtful, seen)
        found = Found.of(fit, se3.inverse(fit.T_camera_world), lost)
        if not lost:
            certain = self.recovery.is_steady and not (self.config.tracking.verify and self.tracker.doubtful)
            found.mapped = certain and self._is_keyframe(fit.overlap)
            if found.mapped and self._cuts:
                found.tracking["drift_m"] = self._add_drift(fit, seen)
        elif (place := self._relocalise(seen)) is not None:
            self._go_to(place, seen, found)
        elif self.recovery.gives_up and usable(seen):
            self._begin_apart(seen, found)
        return found

    def _track(self, seen: Observation) -> PoseFit:
        """Fit the frame's pose to the active submap."""
        with self._timer.stage("track"), self._timer.kernels_of(self.view, "track_kernels"):
            return self.tracker.track(self.mapper.field, self.view, seen)

    def _is_keyframe(self, overlap: float) -> bool:
        c = self.config.mapping
        return is_keyframe(len(self.steps) - self.mapper.keyframes[-1].index, c.every, overlap, c.overlap_below)

    def _add_drift(self, fit: PoseFit, seen: Observation) -> float:
        """Add the hop to this keyframe to the submap's drift; return the standard deviation of its position, metres."""
        T_submap_camera = se3.inverse(fit.T_camera_world)
        self.drift.hop(T_submap_camera, self.tracker.hop_covariance(fit, seen.live))
        return self.drift.position_m(T_submap_camera)

    def _map(self, seen: Observation, T_submap_camera: Matrix) -> Matrix:
        """Map a keyframe; return its pose, which mapping may have moved."""
        index, frame = len(self.steps), seen.frame
        with self._timer.stage("describe"):
            descriptor = self.descriptor.describe(frame.color, frame.depth_m) if self._describes else None
        with self._timer.stage("map"):
            detail = None if seen.image is None else seen.image.detail
            fit = self.mapper.map(self.view, index, seen.target, T_submap_camera, descriptor, detail)
        self._timer.add(fit.seconds, prefix="map_")
        if self.keyframe_indices[-1:] != [index]:  # a keyframe that two submaps share is counted once
            self.keyframe_indices.append(index)
        self.atlas.keyframe_poses[-1] = [keyframe.T_world_camera for keyframe in self.mapper.keyframes]
        self.tracker.keep_keyframe(self.mapper.field, self.view, seen, self.atlas.keyframe_poses[-1][-1])
        return self.atlas.keyframe_poses[-1][-1]

    def _submap_ends(self, T_submap_camera: Matrix) -> bool:
        since, moved_m = len(self.steps) - self.mapper.keyframes[0].index, self.drift.position_m(T_submap_camera)
        return bool(ends_submap(T_submap_camera, since, moved_m, self.config.submaps))

    def _cut(self, T_submap_camera: Matrix) -> list[Loop]:
        """Finish the active submap and start the next one at its newest keyframe; return the loops tried."""
        field, drift = self.mapper.field, self.drift.information
        return self._branch(len(self.store), T_submap_camera, drift, field)

    def _branch(self, parent: int, T_parent_camera: Matrix, information: Matrix, field: GaussianField) -> list[Loop]:
        """Finish the active submap and start the next one at the camera, connected to a parent submap; return the loops
        tried.

        information [6, 6]: of T_parent_camera's left twist; field: the parent's splats, which the new submap may
        inherit.
        """
        with self._timer.stage("cut"):
            loops = self._finish_submap()
            self._begin_at(parent, T_parent_camera, information, field)
            return loops

    def _begin_at(self, parent: int, T_parent_camera: Matrix, information: Matrix, field: GaussianField) -> None:
        """Start a submap at the camera, connected to a parent submap, as `_branch` does."""
        self.closer.connect(parent, len(self.store), T_parent_camera, information)
        self.atlas.begin_submap(T_parent_camera, parent)
        self.mapper = Mapper(self.config, self.random, field).successor(self.view, T_parent_camera)
        self.drift = Drift()

    def _finish_submap(self) -> list[Loop]:
        """Move the active submap to the store and look for its loops, which may move anchors."""
        submap, pictures = self.mapper.finished(len(self.store))
        self.store.save(submap, pictures)
        descriptors = [keyframe.descriptor for keyframe in self.mapper.keyframes]
        return self.closer.submap_finished(
            submap, [d for d in descriptors if d is not None], self.atlas, self.view
        )  # fmt: skip

    # ---- lost and found ----

    def _relocalise(
        self, seen: Observation, elsewhere: bool = False, index_at_most: int | None = INDEX_AT_MOST
    ) -> Relocation | None:
        """Search the map for the camera; elsewhere: only in components that are not connected to the active submap."""
        if not self.config.recovery.relocalise or not usable(seen):
            return None
        components = self.atlas.components
        known = KnownMap(
            self.store, self.atlas.keyframe_poses, self.mapper.keyframes, self.mapper.field,
            lambda s: not elsewhere or components[s] != components[-1],
        )  # fmt: skip
        with self._timer.stage("relocalise"):
            return self.relocaliser.find(known, self.view, seen, index_at_most)

    def _go_to(self, place: Relocation, seen: Observation, found: Found) -> None:
        """Continue where the camera was found: in the active submap, or in a new one that is connected to the place."""
        found.state, submap = RELOCALISED, place.where[0]
        found.tracking |= place.values()
        if submap == len(self.store):
            found.T_submap_camera = place.T_submap_camera
            self.tracker.move_to(self.mapper.field, self.view, place.keyframe, place.T_submap_camera)
        else:
            field = self._splats_of(place)
            found.loops += self._branch(submap, place.T_submap_camera, place.information, field)
            found.T_submap_camera, found.mapped = np.eye(4), True
        self.recovery.found()

    def _splats_of(self, place: Relocation) -> GaussianField:
        return self.store.load(place.where[0]).field.to(self.view.sums.device)

    def _begin_apart(self, seen: Observation, found: Found) -> None:
        """Begin a new map at the camera, whose place in the world is not known yet."""
        found.loops += self._finish_submap()
        self.atlas.begin_submap()
        self.mapper, self.drift = Mapper(self.config, self.random), Drift()
        self.tracker.forget()
        self.recovery.found()
        found.T_submap_camera, found.state, found.mapped = np.eye(4), APART, True

    def _seek_component(self, seen: Observation, found: Found) -> None:
        """Look for a place of another component; two observations that agree join the components."""
        if len(set(self.atlas.components)) < 2:
            return
        place = self._relocalise(seen, elsewhere=True)
        if place is None:
            return
        a, b = place.where[0], len(self.store)
        link = Link(a, b, place.T_submap_camera @ se3.inverse(found.T_submap_camera), place.information)
        if self.recovery.confirms(link, self.atlas):
            self.atlas.join(a, b, link.T_a_b)
            self.closer.connect(a, b, link.T_a_b, link.information)

    def _step_result(self, frame: Frame, found: Found) -> Step:
        component = self.atlas.components[-1]
        state = APART if component and found.state != LOST else found.state
        return Step(
            frame.index, frame.timestamp_s, self.atlas.anchors[-1] @ found.T_submap_camera, found.mapped,
            state == LOST, found.tracking, len(self.mapper.field), len(self.atlas.anchors) - 1,
            tuple(found.loops), self._timer.stop(self.view), state, component,
        )  # fmt: skip

    @property
    def _cuts(self) -> bool:
        """Return whether any rule may end a submap."""
        s = self.config.submaps
        return bool(s.distance_m or s.angle_deg or s.frames or s.uncertainty_m)

    @property
    def _describes(self) -> bool:
        """Return whether any part compares keyframes by their descriptors."""
        m = self.config.mapping
        return (self._cuts and self.config.loops.close) or (m.window > 2 and m.covisibility == "descriptor")
