"""The map as relocalisation reads it: keyframes with images and poses, and the splats of each submap."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Detail
from sigmasplat.data.submap import KeyframeId, Picture, SubmapStore
from sigmasplat.fit.target import Keyframe
from sigmasplat.tracking.feature_image import FeatureImage, gray_levels
from sigmasplat.types import Matrix


@dataclass(frozen=True, eq=False)
class KnownKeyframe:
    """A keyframe of the map: its images and its pose T_submap_camera [4, 4]."""

    picture: Picture
    T_submap_camera: Matrix

    def image(self, camera: Camera) -> FeatureImage:
        """Return the image in which its features are found; camera: of the working images."""
        detail = self.picture.detail or Detail(gray_levels(self.picture.unit_color), camera)
        return FeatureImage(detail, self.picture.depth_m, camera)


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

    def keyframe(self, where: KeyframeId) -> KnownKeyframe:
        """Return one keyframe."""
        submap, k = where
        stored = submap < len(self.store)
        picture = self.store.picture(submap, k) if stored else self.active[k].picture()
        return KnownKeyframe(picture, self.keyframe_poses[submap][k])

    def splats(self, submap: int) -> GaussianField:
        """Return the splats of a submap, in its frame."""
        return self.store.load(submap).field if submap < len(self.store) else self.field
