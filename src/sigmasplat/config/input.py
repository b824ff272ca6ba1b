"""Settings of what is taken from a recording, whatever its format: which frames, whose cameras, which pixels."""

from dataclasses import dataclass
from typing import Literal

from sigmasplat.errors import ConfigError


@dataclass(frozen=True)
class InputConfig:
    """What is taken from the source. Raises ConfigError on values that mean nothing."""

    stride: int = 1
    """Every so many frames one is taken."""
    limit: int = 0
    """At most so many frames; 0 = all."""
    start_s: float = 0.0
    """Seconds after the recording's first frame at which to begin."""
    end_s: float = 0.0
    """… and to stop; 0 = at its end."""
    strict: bool = False
    """Whether an unreadable image ends the sequence instead of being passed over."""

    color_topic: str = ""
    """The topic of a ROS bag that colour is taken of; empty = found by what it holds."""
    depth_topic: str = ""
    """… and depth."""

    calibration: str = ""
    """A calibration.json to use in place of what the recording says of its cameras."""
    fx: float = 0.0
    """The colour camera's focal length in pixels, in place of the recording's; 0 = as recorded."""
    fy: float = 0.0
    """… and the vertical one; 0 = as recorded, or as fx where nothing is."""
    cx: float = 0.0
    """Column of its principal point, pixels; 0 = as recorded, or the image's centre where nothing is."""
    cy: float = 0.0
    """… and its row."""
    depth_scale: float = 0.0
    """PNG units per metre, in place of the recording's; 0 = as recorded."""

    register_depth: Literal["auto", "on", "off"] = "auto"
    """Whether depth is moved into the colour camera's pixels; auto: where the recording says that cameras differ."""
    undistort: bool = True
    """Whether lenses are taken out, where they are known."""
    width: int = 0
    """Working image width in pixels, height in proportion; 0 keeps the source's size."""
    crop_px: int = 0
    """Pixels dropped at every edge, after resizing: where an undistorted image or a sensor's depth has none."""
    min_depth_m: float = 0.1
    """Nearer readings are none: what a sensor says below its range is noise."""
    max_depth_m: float = 8.0
    """Farther ones are none either: errors grow with the square of the depth."""

    def __post_init__(self) -> None:
        if self.stride < 1 or self.limit < 0:
            raise ConfigError(f"stride and limit must be at least 1, found stride={self.stride}, limit={self.limit}")
        if self.start_s < 0 or (self.end_s and self.end_s <= self.start_s):
            raise ConfigError(
                f"input.start_s and input.end_s must span some time, found {self.start_s:g} to {self.end_s:g} s"
            )
