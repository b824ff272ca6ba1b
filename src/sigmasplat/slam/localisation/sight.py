"""One frame, or one keyframe of the map, in the forms that tracking needs."""

from dataclasses import dataclass

from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import Target
from sigmasplat.slam.localisation.feature_image import FeatureImage
from sigmasplat.types import Matrix


@dataclass(eq=False)
class Sight:
    """A frame in the forms that tracking needs: the target of the fits, its pyramid, and the image for features."""

    target: Target
    live: Pyramid
    image: FeatureImage | None = None


@dataclass(frozen=True, eq=False)
class FoundKeyframe:
    """A keyframe of the map that shows what the camera sees: its pyramid, T_camera_world [4, 4] in its submap, and its
    image for features."""

    pyramid: Pyramid
    T_camera_world: Matrix
    image: FeatureImage
