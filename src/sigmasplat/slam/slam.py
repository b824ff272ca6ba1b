"""SLAM: track every frame, map keyframes, cut submaps, close loops. `Slam.step` reads like the paper's overview."""

import time

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.errors import SourceError
from sigmasplat.fit.pose import PoseFit
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import live_image
from sigmasplat.fit.target import Target
from sigmasplat.model import se3
from sigmasplat.model.atlas import Atlas
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.frame import Frame
from sigmasplat.model.submap import MemoryStore, SubmapStore
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.presets import default_preset, preset
from sigmasplat.render.backend import make_view
from sigmasplat.render.view import View
from sigmasplat.slam.drift import Drift
from sigmasplat.slam.final import final_map
from sigmasplat.slam.loops import Loop, LoopCloser, make_descriptor
from sigmasplat.slam.mapper import Mapper
from sigmasplat.slam.rules import ends_submap, is_keyframe
from sigmasplat.slam.step import KERNELS, Step, numbers_of
from sigmasplat.slam.tracker import Tracker
from sigmasplat.types import Matrix, Progress

HOST = torch.device("cpu")


class Slam:
    """Simultaneous localisation and mapping: feed frames to `step`, then call `finish`; read `field` and `trajectory()`
    at any time.

    Frame 0 fixes the gauge: the world is the first camera. Nothing here knows ground truth. Finished submaps go to
    `store`, by default in memory.
    """

    def __init__(self, config: Config | None = None, store: SubmapStore | None = None) -> None:
        self.config = config or preset(default_preset())
        self.random = np.random.default_rng(self.config.seed)
        self.store = MemoryStore() if store is None else store
        self.atlas = Atlas()
        self.mapper = Mapper(self.config, self.random)
        self.tracker = Tracker(self.config.tracking)
        self.drift = Drift()
        self.descriptor = make_descriptor(self.config.loops)
        self.steps: list[Step] = []
        self.keyframes: list[int] = []
        self.view: View | None = None
        self.closer: LoopCloser | None = None
        self._final: GaussianField | None = None

    @property
    def field(self) -> GaussianField:
        """Return the map in the world, in the host's memory: the final one once finished, till then all submaps side by
        side."""
        if self._final is not None:
            return self._final
        active = self.mapper.field
        if not len(self.store):
            return active.to(HOST)
        merged = GaussianField.empty()
        for index in range(len(self.store)):
            merged.append(self.store.load(index).field.moved(torch.from_numpy(self.atlas.anchors[index])))
        if len(self.store) < len(self.atlas.anchors):
            merged.append(active.moved(torch.from_numpy(self.atlas.anchors[-1])))
        return merged

    @property
    def loops(self) -> list[Loop]:
        """Return every pair of submaps tried, with the latest verdict."""
        return list(self.closer.loops) if self.closer else []

    def trajectory(self) -> Trajectory:
        """Return the poses of all frames so far, lost ones included (their log lines say so).

        A frame is remembered relative to the newest keyframe of its time, a keyframe to its submap: where mapping moves
        the one or a loop the other, the frame follows.
        """
        return Trajectory(np.array([s.timestamp_s for s in self.steps]), self.atlas.T_world_camera())

    def step(self, frame: Frame) -> Step:
        """Take in one frame. Raises SourceError if the first frame has no depth or a later one another camera."""
        clock = time.perf_counter()
        i = self.config.input
        frame = frame.prepared(i.width, i.min_depth_m, i.max_depth_m, i.crop_px)
        view = self._view_for(frame)
        before = view.seconds.copy()
        target = Target.of(frame, (view.sums.shape[1], view.sums.shape[2]))
        live = live_image(view, frame.color, frame.depth_m, target)
        seconds = {"prepare": time.perf_counter() - clock}

        tracking: dict[str, float] = {}
        loops: list[Loop] = []
        if not self.steps:
            T_submap_camera, mapped = self._begin(frame, live), True
        else:
            T_submap_camera, fit = self._track(view, target, live, seconds)
            tracking = numbers_of(fit)
            mapped = not self.tracker.lost and self._is_keyframe(fit.overlap)
        if mapped:
            if self.steps and self._cuts:
                self.drift.hop(T_submap_camera, self.tracker.hop_covariance(fit, live))
                tracking["drift_m"] = self.drift.position_m(T_submap_camera)
            T_submap_camera = self._map(view, frame, target, live, T_submap_camera, seconds)
            if self._submap_ends(T_submap_camera):
                loops = self._cut(view, T_submap_camera, seconds)
                T_submap_camera = self._map(view, frame, target, live, np.eye(4), seconds)
        self.atlas.place_frame(T_submap_camera)

        seconds |= dict(zip(KERNELS, (view.seconds - before).tolist(), strict=True))
        step = Step(
            frame.index, frame.timestamp_s, self.atlas.anchors[-1] @ T_submap_camera, mapped, self.tracker.lost,
            tracking, len(self.mapper.field), len(self.atlas.anchors) - 1, tuple(loops),
            seconds | {"total": time.perf_counter() - clock},
        )  # fmt: skip
        self.steps.append(step)
        return step

    def finish(self, progress: Progress = lambda done, total: None) -> None:
        """Finish the last submap, look for its loops, and make the final map (VarSplat §7); once, after all frames.

        `progress` is told (steps of refinement done, of how many), from the beginning to the end; one step where
        there are none. With one submap and no refinement nothing is done.
        """
        if not self.steps or not (len(self.store) or self._cuts or self.config.final.iterations):
            return
        total = self.config.final.iterations or 1
        progress(0, total)
        self._freeze()
        view = self.view
        assert view is not None
        self._final = final_map(self.store, self.atlas.anchors, self.config, view, self.random, progress)
        progress(total, total)

    def checkpoint(self) -> dict[str, Tensor]:
        """Return what a run needs to be read back, in the host's memory: the active submap's field with its optimiser
        state, poses, times, keyframes, anchors, and which submap each frame belongs to."""
        path, active = self.trajectory(), self.mapper.field
        return {
            **{name: getattr(active, name).cpu() for name in ("params", "moment1", "moment2", "last_step")},
            "adam_steps": torch.tensor(active.steps),
            "timestamps_s": torch.from_numpy(path.timestamps_s),
            "T_world_camera": torch.from_numpy(path.T_world_camera),
            "T_world_camera_odometry": torch.from_numpy(self.atlas.T_world_camera(loops=False)),
            "keyframes": torch.tensor(self.keyframes, dtype=torch.int64),
            "T_world_submap": torch.from_numpy(np.array(self.atlas.anchors).reshape(-1, 4, 4)),
            "frame_submap": torch.tensor([place.submap for place in self.atlas.places], dtype=torch.int64),
        }

    @property
    def _cuts(self) -> bool:
        """Tell whether any rule may end a submap."""
        s = self.config.submaps
        return bool(s.distance_m or s.angle_deg or s.frames or s.uncertainty_m)

    @property
    def _describes(self) -> bool:
        """Tell whether anything compares keyframes by their looks."""
        m = self.config.mapping
        return (self._cuts and self.config.loops.close) or (m.window > 2 and m.covisibility == "descriptor")

    def _freeze(self) -> list[Loop]:
        """Hand the active submap to the store and look for its loops, which may move anchors."""
        assert self.closer is not None
        submap, pictures = self.mapper.finished(len(self.store))
        self.store.save(submap, pictures)
        descriptors = [keyframe.descriptor for keyframe in self.mapper.keyframes]
        return self.closer.submap_finished(submap, [d for d in descriptors if d is not None], self.atlas)

    def _cut(self, view: View, T_submap_camera: Matrix, seconds: dict[str, float]) -> list[Loop]:
        """Finish the active submap and begin the next one at its newest keyframe, which both share; return the loops
        tried."""
        clock = time.perf_counter()
        loops = self._freeze()
        assert self.closer is not None
        self.closer.submap_begun(len(self.store), T_submap_camera, self.drift.information)
        self.atlas.begin_submap(T_submap_camera)
        self.mapper = self.mapper.successor(view, T_submap_camera)
        self.drift = Drift()
        seconds["cut"] = time.perf_counter() - clock
        return loops

    def prepare(self, camera: Camera) -> View:
        """Make what renders for the images of a camera, as `Frame.prepared` leaves it; the first frame does it too."""
        c = self.config
        learned = bool(c.mapping.weight_nll_color or c.mapping.weight_nll_depth)
        read = c.tracking.uncertainty and c.tracking.align_depth_by == "V"
        self.view = make_view(c.backend, camera, c.render, variance=learned or read)
        self.closer = LoopCloser(c, self.store, self.view)
        return self.view

    def _view_for(self, frame: Frame) -> View:
        view = self.view or self.prepare(frame.camera)
        if frame.camera != view.camera:
            raise SourceError(f"frame {frame.index} comes from another camera ({frame.camera}) than the first")
        return view

    def _is_keyframe(self, overlap: float) -> bool:
        c = self.config.mapping
        return is_keyframe(len(self.steps) - self.mapper.keyframes[-1].index, c.every, overlap, c.overlap_below)

    def _submap_ends(self, T_submap_camera: Matrix) -> bool:
        since, moved_m = len(self.steps) - self.mapper.keyframes[0].index, self.drift.position_m(T_submap_camera)
        return bool(ends_submap(T_submap_camera, since, moved_m, self.config.submaps))

    def _begin(self, frame: Frame, live: Pyramid) -> NDArray[np.float64]:
        if not (frame.depth_m > 0).any():
            raise SourceError(
                f"frame {frame.index} has no depth reading in [{self.config.input.min_depth_m}, "
                f"{self.config.input.max_depth_m}] m to start a map from; check the depth scale or start at a later one"
            )
        self.tracker.start(live)
        self.atlas.begin_submap()
        return np.eye(4)

    def _track(self, view: View, target: Target, live: Pyramid, seconds: dict[str, float]) -> tuple[Matrix, PoseFit]:
        clock = time.perf_counter()
        before = view.seconds.sum()
        fit = self.tracker.track(self.mapper.field, view, target, live)
        seconds["track"] = time.perf_counter() - clock
        seconds["track_kernels"] = float(view.seconds.sum() - before)
        return se3.inverse(fit.T_camera_world), fit

    def _map(
        self, view: View, frame: Frame, target: Target, live: Pyramid, T_submap_camera: Matrix,
        seconds: dict[str, float],
    ) -> Matrix:  # fmt: skip
        """Map a keyframe; return its pose, which mapping may have moved."""
        clock = time.perf_counter()
        descriptor = self.descriptor.describe(frame.color, frame.depth_m) if self._describes else None
        seconds["describe"], clock = seconds.get("describe", 0.0) + time.perf_counter() - clock, time.perf_counter()
        fit = self.mapper.map(view, len(self.steps), target, T_submap_camera, descriptor)
        for stage, spent in {
            "map": time.perf_counter() - clock,
            **{f"map_{n}": s for n, s in fit.seconds.items()},
        }.items():
            seconds[stage] = seconds.get(stage, 0.0) + spent
        self.keyframes += [len(self.steps)] * (self.keyframes[-1:] != [len(self.steps)])  # a shared one counts once
        self.atlas.keyframes[-1] = [keyframe.T_world_camera for keyframe in self.mapper.keyframes]
        self.tracker.keep_keyframe(self.mapper.field, view, live, self.atlas.keyframes[-1][-1])
        return self.atlas.keyframes[-1][-1]
