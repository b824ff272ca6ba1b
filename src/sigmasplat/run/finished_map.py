"""Read the map of a finished run, to find cameras in it or to continue it in another run."""

import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.submap import GrowingStore, SubmapStore
from sigmasplat.errors import ConfigError, RunError
from sigmasplat.input.source import Source
from sigmasplat.run.scene import config_of_facts, scene_facts
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.run_folder.submaps import DiskStore
from sigmasplat.system.slam import Slam
from sigmasplat.types import Matrix

LEAST_SHARE = 0.5
"""Another camera must see at least this share of the map's images."""


@dataclass(frozen=True, eq=False)
class FinishedMap:
    """The submaps of a finished run, their poses, and the camera of their images.

    anchors: T_world_submap [4, 4] of each submap, or T_component_submap if its component is not connected to the world;
    components: one number per submap, 0 is the world; keyframe_poses: T_submap_camera [4, 4] of their keyframes;
    frames: number of frames of the run; facts: its run.json.
    """

    run: RunFolder
    config: Config
    store: DiskStore
    anchors: list[Matrix]
    components: list[int]
    keyframe_poses: list[list[Matrix]]
    frames: int
    camera: Camera
    facts: dict[str, Any]

    @staticmethod
    def of(run: RunFolder) -> "FinishedMap":
        """Read a run. Raises RunError if it is not complete or kept no submaps."""
        facts = run.facts()
        status = facts.get("status")
        if status != "complete":
            raise RunError(
                f"run {run.path} is not complete (status: {status}); finish it first: sigmasplat resume {run.path}"
            )
        store = run.submaps
        if not len(store):
            raise RunError(
                f"run {run.path} kept no submaps, so no camera can be found in it; run it again with a preset "
                "that makes submaps, such as sigma"
            )
        tensors, _ = run.read_checkpoint()
        anchors = np.asarray(tensors.get("T_world_submap", np.empty((0, 4, 4))), np.float64)
        if len(anchors) < len(store):
            raise RunError(
                f"run {run.path} has {len(store)} submaps, but its checkpoint has poses of {len(anchors)}; run it again"
            )
        known = tensors.get("submap_component")
        components = [0] * len(store) if known is None else [int(number) for number in known]
        poses = [list(np.asarray(store.load(index).T_submap_camera, np.float64)) for index in range(len(store))]
        frames = len(tensors["timestamps_s"])
        camera = store.load(0).camera
        return FinishedMap(run, run.config(), store, list(anchors), components, poses, frames, camera, facts)

    @property
    def members(self) -> list[int]:
        """Return the submaps that are connected to the world."""
        return [index for index, component in enumerate(self.components) if component == 0]

    def config_for(self, source: Source, config: Config, given: Collection[str]) -> Config:
        """Return the settings for a source in this map: their scale is the map's, the noise of depth the source's.

        Settings named in `given` keep their values.
        """
        of_map = ("input.min_depth_m", "input.max_depth_m")  # `config` has the map's already
        facts = scene_facts(source) | {"scene_scale": self.facts.get("scene_scale"), "sensor": None}
        return config_of_facts(facts, config, {*given, *of_map})

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Hold the run during the block, so that no process overwrites it. Raises RunError if one has or does.

        A run that this user cannot write is not locked.
        """
        with self.run.locked() if os.access(self.run.path, os.W_OK) else nullcontext():
            if self.run.facts() != self.facts:
                raise RunError(f"run {self.run.path} was changed by another process; start this command again")
            yield

    def refuse_other_size(self, config: Config) -> None:
        """Raise RunError if settings make working images of another size than those of the map."""
        for name in ("width", "crop_px"):
            ours, theirs = getattr(config.input, name), getattr(self.config.input, name)
            if ours != theirs:
                raise RunError(
                    f"input.{name} is {ours}, but run {self.run.path} was made with {theirs}, and all submaps of a map "
                    f"have images of one size; leave out --set input.{name}"
                )

    def refuse_other_view(self, camera: Camera) -> None:
        """Raise RunError if a camera (of working size) sees too little of what the map's camera sees."""
        if self.camera.share_seen_by(camera) < LEAST_SHARE:
            raise RunError(
                f"the recording's camera ({camera}) sees less than half of the images of run {self.run.path} "
                f"({self.camera}); record with a similar lens, or check --fx and --calibration"
            )


def continue_map(earlier: FinishedMap, config: Config, source: Source, run: RunFolder) -> Slam:
    """Copy the world of an earlier run to a new run's folder, and return a system that continues it.

    run.json of the new run names the earlier one under `onto`. Raises RunError if the camera of the source sees too
    little of what the map's camera sees, or another process has begun to write the earlier run; ConfigError if
    relocalisation is off.
    """
    camera = source.camera.prepared(config.input.width, config.input.crop_px)
    earlier.refuse_other_view(camera)
    refuse_without_relocalisation(config)
    with earlier.unchanged():
        take_over(earlier.store, earlier.members, earlier.frames, run.submaps)
    anchors = [earlier.anchors[index] for index in earlier.members]
    run.note(onto={"run": str(earlier.run.path.resolve()), "submaps": len(anchors)})
    return continued(config, run.submaps.in_background(), anchors)


def take_over(earlier: SubmapStore, members: Sequence[int], frames: int, store: GrowingStore) -> None:
    """Copy submaps of an earlier session, `members`, to the store of a new one.

    frames: number of frames of the earlier session. Its frame numbers become negative: −1 is its last frame. So they
    never equal those of the new session, and a third session continues to count backwards.
    """
    for index, member in enumerate(members):
        submap = earlier.load(member)
        numbers = tuple(frame - frames for frame in submap.frames)
        pictures = [earlier.picture(member, k) for k in range(len(numbers))]
        probe_numbers = tuple(frame - frames for frame in submap.probe_frames)
        probes = [earlier.probe(member, k) for k in range(len(probe_numbers))]
        store.save(replace(submap, index=index, frames=numbers, probe_frames=probe_numbers), pictures, probes)


def continued(config: Config, store: GrowingStore, anchors: Sequence[Matrix]) -> Slam:
    """Return a system that continues the map in `store`; anchors: T_world_submap [4, 4] of its submaps.

    The world is that of the map. The first frame is searched for in it. If it is not found, a new component begins,
    which joins when a place is recognised. Frames of another camera are resampled to the map's camera. Loops to the
    submaps are tried, but their poses relative to each other stay fixed. Raises ConfigError if relocalisation is off.
    """
    refuse_without_relocalisation(config)
    slam = Slam(config, store)
    for index, T_world_submap in enumerate(anchors):
        submap = store.load(index)
        slam.atlas.add_finished(T_world_submap, list(submap.T_submap_camera))
        pictures = (store.picture(index, k) for k in range(len(submap.frames)))
        described = [slam.descriptor.describe(p.unit_color, p.depth_m) for p in pictures] if config.loops.close else []
        slam.closer.add_finished(submap, described, se3.inverse(anchors[0]) @ T_world_submap)
    slam.prepare(store.load(0).camera, resample=True)
    return slam


def refuse_without_relocalisation(config: Config) -> None:
    """Raise ConfigError if relocalisation, which finds a camera in an earlier map, is off."""
    if not config.recovery.relocalise:
        raise ConfigError("to continue a map, relocalisation must be on: --set recovery.relocalise=on")
