"""The whole system: the main loop, the interface for your own camera, covariances, the final map after the last frame,
and the checkpoint."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.config.find_preset import configured
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.data.frame import Frame
from sigmasplat.data.relative_pose import Edges
from sigmasplat.data.submap import GrowingStore, SubmapStore
from sigmasplat.data.trajectory import Component, Trajectory
from sigmasplat.final.final_map import final_map, reaching
from sigmasplat.final.stores import RefinedStore, StorePart, solved_keyframes
from sigmasplat.final.uncertainty import final_uncertainty
from sigmasplat.graph.graph_errors import calibration_std
from sigmasplat.graph.path_covariance import NewestCovariance, PathCovariance, PoseErrors, recorded
from sigmasplat.render.render import as_refined
from sigmasplat.slam.main_loop import MainLoop
from sigmasplat.slam.results import Step
from sigmasplat.slam.slam_state import merged_field
from sigmasplat.system.array_interface import ArrayInterface, Listeners, notifying
from sigmasplat.types import Matrix, Progress, completed, no_progress, part_of
from sigmasplat.uncertainty.map_uncertainty import MapUncertainty


class Slam(MainLoop, ArrayInterface):
    """Simultaneous localisation and mapping: give frames to `step`, or arrays to `track`, then call `finish`; read
    `field` and `trajectory()` at any time.

    Frame 0 fixes the gauge: the world is the first camera. No part of this class reads ground truth. Finished submaps
    go to `store`, by default in memory.

    config: settings, or the name of a preset, by default the default preset; settings: values that replace some, as in
    {"input.width": 320}. Raises ConfigError on an unknown preset or setting.
    """

    def __init__(
        self, config: Config | str | None = None, store: GrowingStore | None = None, *,
        settings: Mapping[str, object] | None = None,
    ) -> None:  # fmt: skip
        super().__init__(configured(config, settings), store)
        self.listeners: Listeners = []
        self._newest_covariance = NewestCovariance()
        self._final: GaussianField | None = None
        self.refinement_steps: int | None = None
        """Number of refinement steps of the final map; None before `finish`."""
        self.uncertainty: MapUncertainty | None = None
        """How sure the final map is; None before `finish`, or without probe views (`uncertainty.probes`)."""

    @property
    def field(self) -> GaussianField:
        """Return the map in the world, in host memory: all submaps side by side, after `finish` the final map."""
        return super().field if self._final is None else self._final

    def components(self) -> list[Component]:
        """Return the components of the atlas that are not connected to the world."""
        atlas, path = self.atlas, self.trajectory()
        component_of, found = np.array(atlas.components, np.int64)[atlas.places.submap], ~self.steps.lost
        return [
            Component(n, merged_field(self.store, atlas, n, self.mapper.field), path.at(found & (component_of == n)))
            for n in sorted(set(atlas.components) - {0})
        ]

    def covariance_of(self, newest: Step) -> Matrix:
        atlas = self.atlas
        T_world_camera = atlas.anchors[-1] @ atlas.keyframe_poses.last[-1] @ atlas.places[-1].T_keyframe_camera
        return self.pose_errors().of(T_world_camera, int(not newest.is_keyframe))

    def pose_errors(self) -> PoseErrors:
        """Return the errors of poses relative to the newest keyframe."""
        return self._newest_covariance.errors(self.atlas, self.closer)

    def checkpoint(self) -> dict[str, Tensor]:
        """Return what is needed to read a run back, in host memory: the active submap's field with its optimiser state,
        poses, times, keyframes, anchors, the submap of each frame, and the errors of the path (`path_covariance`)."""
        path, edges = self.trajectory(), self.closer.valid
        return checkpoint_of(self.mapper.field, path, self.atlas, self.keyframe_indices, edges)

    def step(self, frame: Frame) -> Step:
        """Process one frame: track it, find it in the whole map if it is lost, map it if it is a keyframe, and cut the
        submap if a rule ends it here.

        Raises SourceError if the first frame has no depth or a later one comes from another camera.
        """
        with notifying(self.atlas, self.listeners):
            return super().step(frame)

    def finish(self, progress: Progress = no_progress) -> None:
        """Finish the last submap, look for its loops, and make the final map (VarSplat §7); call it once, at the end.

        Calls `progress(done, total)` with the steps of refinement, from 0 to the last one, and then the keyframes that
        the uncertainty is measured at; without both the total is 1. Does nothing when no rule cuts submaps and
        `final.iterations` is 0. Components that are not connected to the world are left out of the final map.
        """
        with notifying(self.atlas, self.listeners):
            self._finish(progress)

    def _finish(self, progress: Progress) -> None:
        self.settle_late(self.tracker.motion.stopped())
        completed(self.refining(self.mapper.pending))
        if not self.steps or not (len(self.store) or self.cuts or self.config.final.iterations):
            return
        final, photos = self.config.final, any(keyframe.photo for keyframe in self.mapper.keyframes)
        steps = final.iterations * (1 + photos)
        measures = self.config.uncertainty.probes > 0
        total = max(1, steps + measures * self.atlas.keyframe_poses.total)
        progress(0, total)
        completed(self.finish_submap())
        self.settle()
        completed(self.closing())
        self._connect_components()
        self.closer.solve_all(self.atlas)
        members = self.atlas.members(0)
        part = StorePart(self.store, members)
        store: SubmapStore = part
        refining, measuring = (part_of(progress, first, total) for first in (0, steps))
        known = PathCovariance.of_keyframes(self.atlas, self.closer.valid)
        if self.follows:
            calibration = calibration_std(self.config.input, self.view.camera)
            store, poses = solved_keyframes(self.atlas, known, part, self.keyframe_image, self.graph, calibration)
            self.atlas.refined = dict(zip(members, poses, strict=True))
        anchors = [self.atlas.anchors[s] for s in members]
        config = replace(self.config, final=reaching(self.config, known))
        made = final_map(store, anchors, config, self.view, self.random, refining)
        self._final, self.refinement_steps = made.field, made.steps
        refined = RefinedStore(store, made.keyframe_poses, made.keyframe_exposures)
        if made.keyframe_poses is not None:
            self.atlas.refined = dict(zip(members, made.keyframe_poses, strict=True))
        if made.keyframe_exposures is not None:
            self.atlas.exposures = dict(zip(members, made.keyframe_exposures, strict=True))
        shown = replace(self.config, render=as_refined(self.config.render, self.view.camera, made.refined_fx))
        self.uncertainty = final_uncertainty(self._final, refined, anchors, shown, self.view, measuring)
        progress(total, total)


def checkpoint_of(
    active: GaussianField, path: Trajectory, atlas: Atlas, keyframes: Sequence[int], edges: Edges
) -> dict[str, Tensor]:
    """Return the active submap's field with its attributes and its optimiser state, poses, times, keyframes, anchors,
    the submap of each frame, the exposures of frames if they are known, and the errors of the path, in host memory."""
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


def path_errors(atlas: Atlas, keyframes: Sequence[int], edges: Edges) -> dict[str, Tensor]:
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
