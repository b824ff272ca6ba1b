"""Settings of sparse features: kind, number, and the limits of a pose from them."""

from dataclasses import dataclass
from typing import Literal

from sigmasplat.config.ranges import Above0, AtLeastOne, Count, Section


@dataclass(frozen=True)
class FeatureConfig(Section, name="features"):
    """Sparse features for a second guess in tracking, for relocalisation and for loops (ours)."""

    kind: Literal["sift", "orb", "xfeat"] = "sift"
    """Kind of features: sift = RootSIFT; orb = faster, finds fewer poses; xfeat = a neural network with its own
    matcher, finds the most poses and is the slowest. It needs the extra `xfeat`."""
    count: AtLeastOne = 1200
    """Maximum number of features per image; the strongest are used. More features find more poses and take more
    time."""
    width: Count = 640
    """Images wider than this are reduced to this width before detection; 0 = never."""
    ratio: Above0 = 0.9
    """A match is used if its descriptor distance is below this multiple of the distance to the second-best candidate
    (Lowe 2004). Not used by xfeat."""
    ransac_px: Above0 = 3.0
    """A match supports a pose if its reprojection error is below this, in pixels of an image 640 pixels wide; it scales
    with the width."""
    ransac_tries: AtLeastOne = 1000
    """Maximum number of minimal samples per pose. Fewer are drawn if a pose is found with confidence 0.999 sooner."""
