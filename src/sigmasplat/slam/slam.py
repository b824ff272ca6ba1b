"""SLAM in one submap: track every frame, map every keyframe. `Slam.step` reads like the paper's overview."""

import time
from dataclasses import dataclass, field as dataclass_field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.errors import SourceError
from sigmasplat.fit.pyramid import Pyramid, gray_of
from sigmasplat.fit.target import Target
from sigmasplat.model import se3
from sigmasplat.model.field import GaussianField
from sigmasplat.model.frame import Frame
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.presets import default_preset, preset
from sigmasplat.render.view import View, make_view
from sigmasplat.slam.mapper import Mapper
from sigmasplat.slam.rules import is_keyframe
from sigmasplat.slam.tracker import Tracker

KERNELS = ("project", "sort", "blend", "blend_backward", "project_backward")
"""What `View.seconds` counts, in its order."""


@dataclass(frozen=True, eq=False)
class Step:
    """What one frame brought: its pose T_world_camera [4, 4], whether it was mapped, whether it was lost, numbers."""

    index: int
    timestamp_s: float
    T_world_camera: NDArray[np.float64]
    is_keyframe: bool
    lost: bool
    tracking: dict[str, float]
    splats: int
    seconds: dict[str, float] = dataclass_field(default_factory=dict)


class Slam:
    """Simultaneous localisation and mapping: feed frames to `step`; read `field` and `trajectory()` at any time.

    Frame 0 fixes the gauge: the world is the first camera. Nothing here knows ground truth.
    """

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or preset(default_preset())
        self.mapper = Mapper(self.config, np.random.default_rng(self.config.seed))
        self.tracker = Tracker(self.config.tracking)
        self.steps: list[Step] = []
        self._relative: list[tuple[int, NDArray[np.float64]]] = []
        self._view: View | None = None

    @property
    def field(self) -> GaussianField:
        """Return the map."""
        return self.mapper.field

    def trajectory(self) -> Trajectory:
        """Return the poses of all frames so far, lost ones included (their log lines say so).

        A frame is remembered relative to the newest keyframe of its time: where mapping moves that, the frame follows.
        """
        keyframes = self.mapper.keyframes
        poses = [keyframes[k].T_world_camera @ T_keyframe_camera for k, T_keyframe_camera in self._relative]
        return Trajectory(np.array([s.timestamp_s for s in self.steps]), np.array(poses).reshape(-1, 4, 4))

    def step(self, frame: Frame) -> Step:
        """Take in one frame. Raises SourceError if the first frame has no depth or a later one another camera."""
        clock = time.perf_counter()
        i = self.config.input
        frame = frame.prepared(i.width, i.min_depth_m, i.max_depth_m)
        view = self._view_for(frame)
        before = view.seconds.copy()
        target = Target.of(frame, (view.sums.shape[1], view.sums.shape[2]))
        live = Pyramid.of(gray_of(frame.color), frame.depth_m, frame.camera)
        seconds = {"prepare": time.perf_counter() - clock}

        first = not self.mapper.keyframes
        tracking: dict[str, float] = {}
        if first:
            T_world_camera = self._begin(frame, live)
        else:
            T_world_camera, tracking = self._track(view, target, live, seconds)
        lost = self.tracker.lost
        mapped = first or (not lost and self._is_keyframe(tracking["overlap"]))
        if mapped:
            T_world_camera = self._map(view, target, live, T_world_camera, seconds)
        newest = self.mapper.keyframes[-1]
        relative = se3.inverse(newest.T_world_camera) @ T_world_camera
        self._relative.append((len(self.mapper.keyframes) - 1, se3.orthonormalise(relative)))

        seconds |= dict(zip(KERNELS, (view.seconds - before).tolist(), strict=True))
        step = Step(
            frame.index, frame.timestamp_s, T_world_camera, mapped, lost, tracking, len(self.field),
            seconds | {"total": time.perf_counter() - clock},
        )  # fmt: skip
        self.steps.append(step)
        return step

    def checkpoint(self) -> dict[str, Tensor]:
        """Return what a run needs to be read back: the field with its optimiser state, poses, times, keyframes."""
        path = self.trajectory()
        return {
            "params": self.field.params,
            "moment1": self.field.moment1,
            "moment2": self.field.moment2,
            "last_step": self.field.last_step,
            "adam_steps": torch.tensor(self.field.steps),
            "timestamps_s": torch.from_numpy(path.timestamps_s),
            "T_world_camera": torch.from_numpy(path.T_world_camera),
            "keyframes": torch.tensor([k.index for k in self.mapper.keyframes], dtype=torch.int64),
        }

    def _view_for(self, frame: Frame) -> View:
        c = self.config
        if self._view is None:
            weights = c.mapping.weight_nll_color or c.mapping.weight_nll_depth
            self._view = make_view(c.backend, frame.camera, c.render, variance=bool(weights or c.tracking.uncertainty))
        if frame.camera != self._view.camera:
            raise SourceError(f"frame {frame.index} comes from another camera ({frame.camera}) than the first")
        return self._view

    def _is_keyframe(self, overlap: float) -> bool:
        c = self.config.mapping
        return is_keyframe(len(self.steps) - self.mapper.keyframes[-1].index, c.every, overlap, c.overlap_below)

    def _begin(self, frame: Frame, live: Pyramid) -> NDArray[np.float64]:
        if not (frame.depth_m > 0).any():
            raise SourceError(
                f"frame {frame.index} has no depth reading in [{self.config.input.min_depth_m}, "
                f"{self.config.input.max_depth_m}] m to start a map from; check the depth scale or start at a later one"
            )
        self.tracker.start(live)
        return np.eye(4)

    def _track(
        self, view: View, target: Target, live: Pyramid, seconds: dict[str, float]
    ) -> tuple[NDArray[np.float64], dict[str, float]]:
        clock = time.perf_counter()
        before = view.seconds.sum()
        fit = self.tracker.track(self.field, view, target, live)
        seconds["track"] = time.perf_counter() - clock
        seconds["track_kernels"] = float(view.seconds.sum() - before)
        numbers = {
            "agreement": fit.agreement, "overlap": fit.overlap, "first_loss": fit.first_loss,
            "loss": fit.loss, "iterations": float(fit.iterations),
        }  # fmt: skip
        return se3.inverse(fit.T_camera_world), numbers

    def _map(
        self,
        view: View,
        target: Target,
        live: Pyramid,
        T_world_camera: NDArray[np.float64],
        seconds: dict[str, float],
    ) -> NDArray[np.float64]:
        """Map a keyframe; return its pose, which mapping may have moved."""
        clock = time.perf_counter()
        fit = self.mapper.map(view, len(self.steps), target, T_world_camera)
        seconds["map"] = time.perf_counter() - clock
        seconds.update({f"map_{stage}": s for stage, s in fit.seconds.items()})
        T_world_camera = self.mapper.keyframes[-1].T_world_camera
        self.tracker.keep_keyframe(self.field, view, live, T_world_camera)
        return T_world_camera
