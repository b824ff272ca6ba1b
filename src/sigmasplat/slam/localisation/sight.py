"""One frame in the forms that tracking needs."""

from dataclasses import dataclass

from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import Target
from sigmasplat.slam.localisation.feature_image import FeatureImage


@dataclass(eq=False)
class Sight:
    """A frame in the forms that tracking needs: the target of the fits, its pyramid, and the image for features."""

    target: Target
    live: Pyramid
    image: FeatureImage | None = None
