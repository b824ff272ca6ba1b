"""Settings of the surface that is extracted from a finished map."""

from dataclasses import dataclass
from typing import Literal

from sigmasplat.errors import ConfigError


@dataclass(frozen=True)
class SurfaceConfig:
    """The mesh of a finished run: which depth is fused, and what is removed. Raises ConfigError on invalid values."""

    depth: Literal["map", "map+sensor"] = "map"
    """Depth that is fused at each keyframe: map = rendered from its submap (VarSplat §7); map+sensor = the keyframe's
    own readings, and the final map where the sensor has none (ours)."""

    def __post_init__(self) -> None:
        if self.depth not in ("map", "map+sensor"):
            raise ConfigError(f"surface.depth must be map or map+sensor, found {self.depth}")
