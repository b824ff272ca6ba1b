"""One frame, or one keyframe of the map, in the forms that tracking needs."""

from dataclasses import dataclass, field

from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import Target
from sigmasplat.model.frame import Frame
from sigmasplat.slam.localisation.feature_image import FeatureImage
from sigmasplat.types import Matrix


@dataclass(eq=False)
class Sight:
    """A frame in the forms that tracking needs: the target of the fits, its pyramid, and the image for features."""

    target: Target
    live: Pyramid
    image: FeatureImage | None = None


@dataclass(eq=False)
class Observation(Sight):
    """A frame in the forms that tracking and mapping need."""

    frame: Frame = field(kw_only=True)


@dataclass(frozen=True, eq=False)
class FoundKeyframe:
    """A keyframe of the map that shows what the camera sees: its pyramid, T_camera_world [4, 4] in its submap, and its
    image for features."""

    pyramid: Pyramid
    T_camera_world: Matrix
    image: FeatureImage
