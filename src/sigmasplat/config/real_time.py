"""Settings of the real-time clock."""

from dataclasses import dataclass

from sigmasplat.config.ranges import AtLeastOne, Count, NotNegative, Section


@dataclass(frozen=True)
class RealTimeConfig(Section, name="realtime"):
    """Live cameras and `run --realtime`: when frames become keyframes, and how much mapping may wait. Raises
    ConfigError on invalid values."""

    live: bool = True
    """Whether live cameras run in real time; off = a frame waits until the one before it is mapped."""
    keyframe_deg: NotNegative = 5.0
    """A frame becomes a keyframe when the image has moved by this angle since the last keyframe: rotation plus
    translation divided by the mean depth. There are not more keyframes than in a recording (`mapping.every`), because
    each adds an error to the path, unless the overlap is low. 0 = by the number of frames, as in a recording."""
    waiting_most: AtLeastOne = 24
    """Maximum number of keyframes that wait for mapping; while as many wait, no frame becomes a keyframe."""
    spare_iterations: Count = 60
    """Maximum number of additional iterations after a keyframe is mapped, while no other keyframe waits; 0 = none."""
