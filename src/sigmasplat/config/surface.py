"""Settings of the surface that is extracted from a finished map."""

from dataclasses import dataclass
from typing import Literal

from sigmasplat.config.ranges import Section


@dataclass(frozen=True)
class SurfaceConfig(Section, name="surface"):
    """The mesh of a finished run. Raises ConfigError on invalid values."""

    depth: Literal["map", "map+sensor"] = "map+sensor"
    """Depth that is fused at each keyframe: map = rendered from its submap (VarSplat §7); map+sensor = rendered from
    the final map, and the readings of the keyframe, weighted by their variances (ours)."""
