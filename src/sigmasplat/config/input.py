"""Settings of the input, for every format: which frames, which calibration, which pixels."""

from dataclasses import dataclass
from typing import Literal

from sigmasplat.errors import ConfigError


@dataclass(frozen=True)
class InputConfig:
    """Selection and processing of the frames of a source. Raises ConfigError on invalid values."""

    stride: int = 1
    """Use every N-th frame."""
    limit: int = 0
    """Maximum number of frames; 0 = all."""
    start_s: float = 0.0
    """Start this many seconds after the first frame of the recording."""
    end_s: float = 0.0
    """Stop this many seconds after the first frame of the recording; 0 = at its end."""
    hold_every: int = 0
    """Hold back every N-th frame: it is tracked but never becomes a keyframe, so that it can test the map; 0 = none."""
    strict: bool = False
    """Whether an unreadable image stops the run. If off, such images are skipped and counted."""

    color_topic: str = ""
    """Topic of the colour images in a ROS bag; empty = detected from the messages."""
    depth_topic: str = ""
    """Topic of the depth images in a ROS bag; empty = detected from the messages."""

    calibration: str = ""
    """Path of a calibration.json that replaces the calibration of the recording; empty = as recorded."""
    fx: float = 0.0
    """Horizontal focal length of the colour camera in pixels; 0 = as recorded."""
    fy: float = 0.0
    """Vertical focal length of the colour camera in pixels; 0 = as recorded, or equal to fx if nothing is recorded."""
    cx: float = 0.0
    """Column of the colour camera's principal point in pixels; 0 = as recorded, or the image centre if nothing is
    recorded."""
    cy: float = 0.0
    """Row of the colour camera's principal point in pixels; 0 = as recorded, or the image centre if nothing is
    recorded."""
    depth_scale: float = 0.0
    """Units of the depth images per metre; 0 = as recorded."""

    register_depth: Literal["auto", "on", "off"] = "auto"
    """Whether depth is registered to the pixels of the colour camera; auto = if the recording has a separate depth
    camera."""
    undistort: bool = True
    """Whether lens distortion is removed, if it is known."""
    width: int = 0
    """Width of the working images in pixels, height in proportion; 0 = as in the source."""
    crop_px: int = 0
    """Pixels removed at each edge after resizing, for undistorted images or sensors without depth at the edges."""
    min_depth_m: float = 0.1
    """Smaller depth readings are ignored: below its range a sensor returns noise."""
    max_depth_m: float = 8.0
    """Larger depth readings are ignored: their errors grow with the square of the depth."""
    stereo_disparities: int = 0
    """Range of disparities that stereo matching searches, in pixels, rounded up to a multiple of 16. It limits the
    smallest depth to f·b / range. 0 = an eighth of the image width."""
    stereo_std_px: float = 0.33
    """Standard deviation σ_d of the disparity in pixels. Stereo depth z has σ_z = z²·σ_d / (f·b)."""
    stereo_max_std: float = 0.05
    """Stereo depth is ignored where its standard deviation σ_z is larger than this share of it."""
    denoise_depth: bool = False
    """Whether depth images that are noisier than those of a structured-light sensor are smoothed."""

    def __post_init__(self) -> None:
        if self.stride < 1 or self.limit < 0:
            raise ConfigError(
                "input.stride must be at least 1 and input.limit at least 0, "
                f"found stride={self.stride}, limit={self.limit}"
            )
        if self.hold_every < 0 or self.hold_every == 1:
            raise ConfigError(f"input.hold_every must be 0 or at least 2, found {self.hold_every}")
        if self.stereo_std_px <= 0:
            raise ConfigError(f"input.stereo_std_px must be above 0, found {self.stereo_std_px:g}")
        if self.start_s < 0 or (self.end_s and self.end_s <= self.start_s):
            raise ConfigError(f"input.end_s must be after input.start_s, found {self.start_s:g} to {self.end_s:g} s")
