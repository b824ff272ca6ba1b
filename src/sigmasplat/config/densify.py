"""Settings of pruning, splitting and cloning splats during mapping."""

from dataclasses import dataclass
from typing import Annotated, Literal

from sigmasplat.config.ranges import NotNegative, Range, Section, Share


@dataclass(frozen=True)
class DensifyConfig(Section, name="primitives"):
    """Pruning, splitting and cloning of splats, halfway through the steps of a keyframe and after them (CG-SLAM §4,
    5)."""

    uncertain_m2: NotNegative = 0.025
    """A splat is uncertain if the mean squared difference between its depth and the depth readings at its pixels, over
    the window, is above this (ν > τ, CG-SLAM eq. 13). It fades halfway through the steps of a keyframe, and is removed
    at the end unless it has recovered; 0 = off."""
    owner: Literal["dominant", "median"] = "dominant"
    """Which splat of a pixel is compared with its depth reading: the one with the largest weight (paper), or the one at
    the median depth (CG-SLAM's code)."""
    faded_opacity: Annotated[float, Range(0, 1, open_below=True)] = 0.07
    """Opacity of a faded splat. It is above `render.alpha_min`, so that the splat is still drawn and can recover
    (ours)."""
    least_opacity: Share = 15.0 / 255.0
    """A faded splat has recovered if it is no longer uncertain and has at least this opacity (CG-SLAM's α_min)."""
    split_gradient: NotNegative = 0.0
    """A splat is densified if the mean gradient of the loss with respect to its 2D position in the newest keyframe is
    at least this, per half image size (3DGS); 0 = no splat is split or cloned for its gradient."""
    split_scale_m: NotNegative = 0.05
    """A densified splat larger than this is split in two."""
    split_radius_px: NotNegative = 13.0  # else an inherited map becomes coarser as the camera moves
    """A splat whose radius (three standard deviations) in the newest keyframe's image exceeds this is split in two as
    well: it was made for a view from farther away (ours). 0 = off."""
    clone: bool = False
    """Whether a densified splat that is too small to be split is cloned (3DGS; not in CG-SLAM's code)."""
    most_scale_m: NotNegative = 0.0
    """Splats larger than this are removed; 0 = off."""
