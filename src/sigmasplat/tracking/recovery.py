"""Count lost and steady frames, and decide what follows: map again, or begin a new map."""

from dataclasses import dataclass, replace

import numpy as np

from sigmasplat.config import RecoveryConfig
from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.tracking.prepared_frame import PreparedFrame

LEAST_READINGS = 0.05
"""A frame with depth on a smaller share of its pixels is not usable: it cannot be recognised or begin a map."""
LEAST_CONTRAST = 5.0
"""A frame whose gray values, 0 to 255, have a smaller standard deviation is not usable either."""
SAME_M, SAME_RAD = 0.1, np.deg2rad(5.0)
"""Two observations of the pose between two components agree if they differ by less than this, in a room."""


def has_depth(seen: PreparedFrame) -> bool:
    """Return whether a frame has enough readings of depth to be used at all."""
    return seen.target.valid_pixels >= LEAST_READINGS * seen.target.camera.width * seen.target.camera.height


def usable(seen: PreparedFrame) -> bool:
    """Return whether a frame shows enough to be recognised or to begin a map."""
    return has_depth(seen) and (seen.image is None or float(seen.image.detail.gray.std()) >= LEAST_CONTRAST)


@dataclass(eq=False)
class Recovery:
    """lost: usable frames in a row in which the camera was not found; steady: frames in a row tracked without doubt
    since the camera was last lost; link: the last observation of another component, which waits for a second one."""

    config: RecoveryConfig
    lost: int = 0
    steady: int = 1_000_000
    link: RelativePose | None = None

    def count(self, lost: bool, doubtful: bool, seen: PreparedFrame) -> None:
        """Count a frame."""
        if lost:
            self.lost += usable(seen)
            self.steady = 0
        else:
            self.lost = 0
            self.steady = 0 if doubtful and self.steady < self.config.steady_frames else self.steady + 1

    @property
    def is_steady(self) -> bool:
        """Return whether the pose may be used for mapping."""
        return self.steady >= self.config.steady_frames

    @property
    def gives_up(self) -> bool:
        """Return whether a new map begins."""
        return bool(self.config.new_map_after) and self.lost >= self.config.new_map_after

    def found(self) -> None:
        """Restart the counts: the camera has been found, or a new map has begun."""
        self.lost = self.steady = 0

    def confirms(self, link: RelativePose, atlas: Atlas, scene_scale: float = 1.0) -> bool:
        """Return whether a new observation agrees with the last one; keep the new one for the next call."""
        before, self.link = self.link, link
        if before is None or {atlas.components[s] for s in (before.a, before.b)} != {
            atlas.components[s] for s in (link.a, link.b)
        }:
            return False
        if atlas.components[before.a] != atlas.components[link.a]:
            before = replace(before, a=before.b, b=before.a, T_a_b=se3.inverse(before.T_a_b))
        between = atlas.anchors[before.a] @ before.T_a_b @ se3.inverse(atlas.anchors[before.b])
        prediction = se3.inverse(atlas.anchors[link.a]) @ between @ atlas.anchors[link.b]
        apart = se3.inverse(prediction) @ link.T_a_b
        near = float(np.linalg.norm(apart[:3, 3])) < SAME_M * scene_scale
        return near and se3.rotation_angle(apart[:3, :3]) < SAME_RAD
