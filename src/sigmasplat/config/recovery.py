"""Settings for lost tracking."""

from dataclasses import dataclass

from sigmasplat.config.ranges import AtLeastOne, Count, Section


@dataclass(frozen=True)
class RecoveryConfig(Section, name="recovery"):
    """Relocalisation of a lost camera, and new maps if it is not found (ours)."""

    relocalise: bool = True
    """Whether a lost camera is searched for in the keyframes of all submaps, by features; off = only near the last pose
    (papers)."""
    candidates: AtLeastOne = 8
    """Number of keyframes, those with the most matches, from which the pose of a lost camera is computed and
    verified."""
    steady_frames: Count = 2
    """After the camera was lost, nothing is mapped until this many frames in a row have been tracked without doubt;
    0 = off (papers)."""
    new_map_after: Count = 20
    """A new map begins after this many lost frames in a row; frames without depth or with a flat image do not count. It
    joins the old map when a place is recognised; 0 = never."""
