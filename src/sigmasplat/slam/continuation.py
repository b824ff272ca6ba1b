"""Start SLAM on a map that an earlier session made."""

from collections.abc import Sequence
from dataclasses import replace

from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.submap import SubmapStore
from sigmasplat.errors import ConfigError
from sigmasplat.slam.slam import Slam
from sigmasplat.types import Matrix


def take_over(earlier: SubmapStore, members: Sequence[int], frames: int, store: SubmapStore) -> None:
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


def continued(config: Config, store: SubmapStore, anchors: Sequence[Matrix]) -> Slam:
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
        slam.confidence.begun(None, 0.0)
        slam.closer.add_finished(submap, described, se3.inverse(anchors[0]) @ T_world_submap)
    slam.prepare(store.load(0).camera, resample=True)
    return slam


def refuse_without_relocalisation(config: Config) -> None:
    """Raise ConfigError if relocalisation, which finds a camera in an earlier map, is off."""
    if not config.recovery.relocalise:
        raise ConfigError("to continue a map, relocalisation must be on: --set recovery.relocalise=on")
