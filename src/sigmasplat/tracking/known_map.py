"""The map as relocalisation reads it: keyframes with images and poses, and the splats of each submap."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sigmasplat.data.field import GaussianField
from sigmasplat.data.submap import KeyframeId, Picture, SubmapStore
from sigmasplat.fit.target import Keyframe
from sigmasplat.types import Matrix


@dataclass(frozen=True, eq=False)
class KnownMap:
    """Finished submaps in a store, and the active one by its keyframes and splats.

    keyframe_poses: T_submap_camera [4, 4] of the keyframes of each submap (`Atlas.keyframe_poses`); wanted: whether a
    submap is searched.
    """

    store: SubmapStore
    keyframe_poses: Sequence[Sequence[Matrix]]
    active: Sequence[Keyframe]
    field: GaussianField
    wanted: Callable[[int], bool] = lambda submap: True

    def keyframes(self) -> list[KeyframeId]:
        """Return all keyframes to search, the newest first."""
        found = [(s, k) for s, poses in enumerate(self.keyframe_poses) if self.wanted(s) for k in range(len(poses))]
        return found[::-1]

    def picture(self, where: KeyframeId) -> Picture:
        """Return the images of a keyframe."""
        submap, k = where
        return self.store.picture(submap, k) if submap < len(self.store) else self.active[k].picture()

    def T_submap_camera(self, where: KeyframeId) -> Matrix:
        """Return the pose [4, 4] of a keyframe."""
        return self.keyframe_poses[where[0]][where[1]]

    def splats(self, submap: int) -> GaussianField:
        """Return the splats of a submap, in its frame."""
        return self.store.load(submap).field if submap < len(self.store) else self.field
