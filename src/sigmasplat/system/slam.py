"""The whole system: the main loop, the interface for your own camera, and the final map after the last frame."""

from collections.abc import Callable, Mapping
from dataclasses import replace

from sigmasplat.config import Config
from sigmasplat.config.find_preset import configured
from sigmasplat.config.input import RENDERED
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.submap import SubmapStore
from sigmasplat.final.final_map import final_map, reaching
from sigmasplat.final.stores import RefinedStore, StorePart, solved_keyframes
from sigmasplat.final.uncertainty import final_uncertainty
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.render.render import as_refined
from sigmasplat.slam.main_loop import MainLoop
from sigmasplat.slam.results import Step
from sigmasplat.system.array_interface import ArrayInterface, Listeners, notifying
from sigmasplat.types import completed, no_progress, part_of
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
        self,
        config: Config | str | None = None,
        store: SubmapStore | None = None,
        *,
        settings: Mapping[str, object] | None = None,
    ) -> None:
        super().__init__(configured(config, settings), store)
        self.listeners = Listeners()
        self._final: GaussianField | None = None
        self.refinement_steps: int | None = None
        """Number of refinement steps of the final map; None before `finish`."""
        self.uncertainty: MapUncertainty | None = None
        """How sure the final map is; None before `finish`, or without probe views (`uncertainty.probes`)."""

    @property
    def field(self) -> GaussianField:
        """Return the map in the world, in host memory: the final map after `finish`, before that all submaps side by
        side."""
        return super().field if self._final is None else self._final

    @notifying
    def step(self, frame: Frame) -> Step:
        """Process one frame: track it, find it in the whole map if it is lost, map it if it is a keyframe, and cut the
        submap if a rule ends it here.

        Raises SourceError if the first frame has no depth or a later one comes from another camera.
        """
        return super().step(frame)

    @notifying
    def finish(self, progress: Callable[[int, int], None] = no_progress) -> None:
        """Finish the last submap, look for its loops, and make the final map (VarSplat §7); call it once, at the end.

        Calls `progress(done, total)` with the steps of refinement, from 0 to the last one, and then the keyframes that
        the uncertainty is measured at; without both the total is 1. Does nothing when no rule cuts submaps and
        `final.iterations` is 0. Components that are not connected to the world are left out of the final map.
        """
        completed(self.refining(self.mapper.pending))
        if not self.steps or not (len(self.store) or self.cuts or self.config.final.iterations):
            return
        steps, measures = self._refinement_steps(), self.config.uncertainty.probes > 0
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
            store, poses = solved_keyframes(
                self.atlas, known, part, self.keyframe_image, self.graph, self.config.input.sensor == RENDERED
            )
            self.atlas.refined = dict(zip(members, poses, strict=True))
        anchors = [self.atlas.anchors[s] for s in members]
        config = replace(self.config, final=reaching(self.config, known))
        final = final_map(store, anchors, config, self.view, self.random, refining)
        self._final, self.refinement_steps = final.field, final.steps
        refined = RefinedStore(store, final.keyframe_poses, final.keyframe_exposures)
        if final.keyframe_poses is not None:
            self.atlas.refined = dict(zip(members, final.keyframe_poses, strict=True))
        if final.keyframe_exposures is not None:
            self.atlas.exposures = dict(zip(members, final.keyframe_exposures, strict=True))
        shown = replace(self.config, render=as_refined(self.config.render, self.view.camera, final.refined_fx))
        self.uncertainty = final_uncertainty(self._final, refined, anchors, shown, self.view, measuring)
        progress(total, total)

    def _refinement_steps(self) -> int:
        """Return the number of steps of the final map's refinement, at working size and on photos."""
        final, photos = self.config.final, any(keyframe.photo for keyframe in self.mapper.keyframes)
        return final.iterations + final.width_iterations * (photos and final.iterations > 0)
