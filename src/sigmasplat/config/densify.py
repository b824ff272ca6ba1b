"""Settings of how splats are judged, thinned and multiplied while they are fitted."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class DensifyConfig:
    """What happens to single splats halfway through a keyframe's steps, and after them (CG-SLAM §4, 5)."""

    uncertain_m2: float = 0.0
    """A splat is uncertain when the depths it is held against, over the window, scatter about its own by more than this
    (ν > τ, CG-SLAM eq. 13): halfway it fades, and goes at the end unless it has come back. 0 = off."""
    owner: Literal["dominant", "median"] = "dominant"
    """Which splat of a pixel is held against its reading: the one of largest weight (paper), or the one at median depth
    (CG-SLAM's code)."""
    faded_opacity: float = 0.07
    """The opacity of a faded splat: above `render.alpha_min`, so that it is still seen and may come back (ours)."""
    least_opacity: float = 15.0 / 255.0
    """… and has come back when it is no longer uncertain, and not fainter than this (CG-SLAM's α_min)."""
    split_gradient: float = 0.0
    """A splat is hot when the loss pulls at its mean by more than this, in the newest keyframe's images, per half image
    size (3DGS); 0 = off: nothing is split or cloned."""
    split_scale_m: float = 0.05
    """A hot splat larger than this is split in two …"""
    split_radius_px: float = 0.0
    """Also split is what spans more than this (three standard deviations) in the newest keyframe's image: splats that a
    camera comes close to were made for a view from afar (ours); 0 = off."""
    clone: bool = False
    """… a smaller one is doubled (3DGS; CG-SLAM's code does not)."""
    most_scale_m: float = 0.0
    """Splats larger than this go; 0 = off."""
    most_radius_px: float = 0.0
    """Splats whose three standard deviations span more than this in the newest keyframe go; 0 = off."""
