"""Settings of the predicted variance of colour and depth."""

from dataclasses import dataclass

from sigmasplat.errors import ConfigError


@dataclass(frozen=True)
class UncertaintyConfig:
    """Calibration of the variance that a map predicts for its colour and depth (ours). Raises ConfigError on invalid
    values."""

    probes: int = 0
    """Number of probe views that each submap keeps: well-tracked frames that are not keyframes. The map is not fitted
    to them; the predicted variance is calibrated on them after the last frame. 0 = no predicted variance."""

    def __post_init__(self) -> None:
        if self.probes < 0:
            raise ConfigError(f"uncertainty.probes must be at least 0, found {self.probes}")
