"""A keyframe in the form that tracking needs: a reference to align to, and the image for features."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from sigmasplat.config import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.references import Reference, keyframe_reference
from sigmasplat.render.view import View
from sigmasplat.tracking.feature_image import FeatureImage
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask
from sigmasplat.tracking.prepared_frame import PreparedFrame
from sigmasplat.types import Matrix


class Splats(Protocol):
    """What tracking reads of a map: rows of splats [N, 17]."""

    @property
    def params(self) -> Tensor: ...


@dataclass(frozen=True, eq=False)
class TrackedKeyframe:
    """What tracking keeps of a keyframe. The map's `Keyframe` has planes for the fits instead, and the state of Adam:
    neither needs the other's memory.

    reference: its image with the weights of the map, None if nothing aligns to it; image: for features; front: what
    was in front of the scene."""

    reference: Reference | None
    image: FeatureImage | None
    front: DynamicMask | None = None

    def weighed(self, params: Tensor, view: View, config: TrackingConfig) -> "TrackedKeyframe":
        """Return a keyframe of the map at which the camera was found, weighed by the map with rows `params` [N, 17]."""
        assert self.reference is not None and self.image is not None
        own = self.reference
        reference = keyframe_reference(params, view, own.pyramid, own.T_camera_world, config)
        return TrackedKeyframe(reference, self.image.weighed(reference.weights))


def mapped_keyframe(
    params: Tensor,
    view: View,
    seen: PreparedFrame,
    T_world_camera: Matrix,
    config: TrackingConfig,
    front: DynamicMask | None,
) -> TrackedKeyframe:
    """Return a keyframe that was just mapped, weighed by the map with rows `params` [N, 17]."""
    if config.method != "align" and not fits_of(view).aligns:
        return TrackedKeyframe(None, seen.image, front)  # nothing aligns to it
    T_camera_world = se3.inverse(T_world_camera)
    reference = keyframe_reference(params, view, seen.live, T_camera_world, config)
    return TrackedKeyframe(reference, seen.image and seen.image.weighed(reference.weights), front)
