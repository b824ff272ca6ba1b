"""Settings of what happens when tracking is lost."""

from dataclasses import dataclass


@dataclass(frozen=True)
class RecoveryConfig:
    """Relocalisation of a lost camera, and new maps where it is not found (ours)."""

    relocalise: bool = False
    """Whether a lost camera is searched for in the keyframes of all submaps, by features; off = only near the last pose
    (papers)."""
    candidates: int = 8
    """Number of keyframes, those with the most matches, from which the pose of a lost camera is computed and
    verified."""
    steady_frames: int = 2
    """After the camera was lost, nothing is mapped until this many frames in a row have been tracked without doubt."""
    new_map_after: int = 0
    """After this many lost frames with a usable image in a row a new map begins, which joins the old one when a place
    is recognised; 0 = never."""
