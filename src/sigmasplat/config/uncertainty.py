"""Settings of the predicted variance of colour and depth."""

from dataclasses import dataclass

from sigmasplat.config.ranges import Count, Section


@dataclass(frozen=True)
class UncertaintyConfig(Section, name="uncertainty"):
    """Calibration of the variance that a map predicts for its colour and depth (ours). Raises ConfigError on invalid
    values."""

    probes: Count = 4
    """Number of probe views that each submap keeps: well-tracked frames that are not keyframes. The map is not fitted
    to them; the predicted variance is calibrated on them after the last frame. 0 = no predicted variance."""
